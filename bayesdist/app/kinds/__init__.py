"""Inputs, matching, fitting and sampling for each kind of run."""
