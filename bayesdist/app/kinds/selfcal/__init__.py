"""Runs without a catalogue: the distortion from dithered exposures alone."""
