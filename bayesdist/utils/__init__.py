"""Helpers for all subpackages: array types, number formatting, limits, random streams, memory."""
