"""Matched stars prepared for a model (in memory, on disk or on a cluster), and their likelihood."""
