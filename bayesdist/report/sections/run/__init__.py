"""Sections that every run has."""
