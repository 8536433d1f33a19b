"""Error terms: whatever moves a position beside the noise of its own measurement."""
