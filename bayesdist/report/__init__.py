"""Figures and the report that a person reads: the only home of matplotlib and corner."""
