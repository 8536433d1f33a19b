"""Distortion entries in WISE meta-data files."""
