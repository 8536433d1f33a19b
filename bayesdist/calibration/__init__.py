"""Calibrations: maps between the pixels of a detector and a plane, with their errors.

This subpackage does not access files.  The formats in `bayesdist.products` convert between files
and calibrations.
"""
