"""Formats of calibration files, one module or subpackage per format."""
