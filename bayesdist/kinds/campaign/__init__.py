"""A campaign: calibration of many exposures from their star lists and a reference catalogue."""
