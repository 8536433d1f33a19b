"""The difference between two calibrations, with its uncertainty."""
