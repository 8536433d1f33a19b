"""Errors of look-up tables between their nodes."""
