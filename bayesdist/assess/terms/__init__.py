"""Error terms: whatever moves a position."""
