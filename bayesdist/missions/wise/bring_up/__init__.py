"""Bring-up of a calibration from unmatched star lists, by alternate matching and fitting."""
