"""Error terms: contributions to the error of a position."""
