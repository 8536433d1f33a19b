"""Columns and labels that matches are made of: completed, checked, and joined."""
