"""Artefacts of a run that are values by themselves: matches, fit, parts, errors, stars as read."""
