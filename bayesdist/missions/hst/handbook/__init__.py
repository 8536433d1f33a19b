"""Figures and numbers of section 4.1 of the ACS handbook for any calibration."""
