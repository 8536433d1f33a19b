"""Runs of stars that were matched before: configuration, reading, fit, `calibrate`, `init`."""
