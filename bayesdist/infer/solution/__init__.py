"""Solutions (parameters with covariance and draws): the linear fit and transformed solutions."""
