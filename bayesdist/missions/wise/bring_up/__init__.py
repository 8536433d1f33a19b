"""The first weeks of a calibration: matching and fitting in turn, from lists of stars."""
