"""Stars that were matched before the run: reading, mission formats, added errors."""
