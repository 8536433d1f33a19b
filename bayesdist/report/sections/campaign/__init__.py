"""Sections of runs that began with star lists."""
