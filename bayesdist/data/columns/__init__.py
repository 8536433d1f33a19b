"""Columns and labels of matches: default values, checks, and concatenation."""
