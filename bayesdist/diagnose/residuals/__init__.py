"""Residuals in bins and samples, and whether they are those of noise."""
