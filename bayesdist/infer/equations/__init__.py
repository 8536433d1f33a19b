"""Normal equations: sums over the stars, their null space, priors, and how they are solved."""
