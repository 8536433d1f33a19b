"""The distortion entries of WISE meta-data."""
