"""Diagnosis and evaluation of a run: settings, error terms, checks."""
