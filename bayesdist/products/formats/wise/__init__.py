"""Distortion entries of WISE meta-data."""
