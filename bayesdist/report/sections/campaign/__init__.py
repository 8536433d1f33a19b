"""Sections of runs on star lists."""
