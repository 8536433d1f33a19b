"""Residuals in bins and samples: their tables, and whether they are those of noise."""
