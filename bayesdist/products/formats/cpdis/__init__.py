"""Look-up tables by CPDIS and DP records, of FITS WCS Paper IV."""
