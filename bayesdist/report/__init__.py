"""Figures and the report: the only room that uses matplotlib."""
