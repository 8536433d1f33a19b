"""Errors that look-up tables leave between their nodes."""
