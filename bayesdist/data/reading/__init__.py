"""Columns of any file to matches: the user's options, known names of columns, and valid rows."""
