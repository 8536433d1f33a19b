"""Columns of any file to matches: what the user says, what the names say, and which rows count."""
