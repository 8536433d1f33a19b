"""The posterior density, and its Laplace approximation on a grid of hyperparameters."""
