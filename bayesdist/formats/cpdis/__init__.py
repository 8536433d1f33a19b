"""Look-up tables with CPDIS and DP records (FITS WCS Paper IV)."""
