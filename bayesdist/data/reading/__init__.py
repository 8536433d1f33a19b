"""Conversion of table columns to matches: reading options, column names, and valid rows."""
