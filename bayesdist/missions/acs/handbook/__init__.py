"""What section 4.1 of the ACS handbook shows of a detector, for any calibration."""
