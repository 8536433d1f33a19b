"""Solutions: parameters with their covariance; the linear fit, and transformed ones."""
