"""Pairs of WISE detections and 2MASS stars (RvB)."""
