"""Comparison of stars held out of the fit with their predictive distribution."""
