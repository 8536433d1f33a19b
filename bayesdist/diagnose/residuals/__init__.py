"""Residuals in bins and samples: tables, and tests for structure and for wrong errors."""
