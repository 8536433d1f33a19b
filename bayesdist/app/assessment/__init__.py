"""A run diagnosed and evaluated: settings, error terms, checks."""
