"""Exposures that were fitted jointly and each alone: series, drift, new ones, filters, releases."""
