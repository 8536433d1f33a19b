"""Self-calibration: distortion from dithered exposures without a reference catalogue."""
