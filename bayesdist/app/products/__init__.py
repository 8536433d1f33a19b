"""Files for pipelines, and what they differ from the solution by."""
