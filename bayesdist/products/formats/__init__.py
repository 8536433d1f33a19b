"""Formats of calibration files, one module or folder each."""
