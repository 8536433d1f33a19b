"""Products for pipelines, and their differences from the solution."""
