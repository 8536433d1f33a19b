"""The error budget: of a detector, of a position, and as a function of where one looks."""
