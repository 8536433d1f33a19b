"""Formats of star lists and matches of other programs."""
