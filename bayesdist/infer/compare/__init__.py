"""Comparison of solutions: polynomial orders, periods, dates of change, planned exposures."""
