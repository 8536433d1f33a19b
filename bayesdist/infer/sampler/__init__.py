"""Sampling of the posterior: moves, ensembles, stopping rule, checkpoints."""
