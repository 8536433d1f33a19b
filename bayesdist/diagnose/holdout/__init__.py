"""Stars held out of the fit, against their predictive distribution."""
