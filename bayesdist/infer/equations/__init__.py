"""Normal equations: accumulation over the stars, rank, priors, and solution."""
