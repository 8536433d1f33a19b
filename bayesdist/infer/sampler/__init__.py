"""Sampling the posterior: moves, ensembles, convergence, checkpoints."""
