"""Stars that were matched before: reading, formats of missions, added errors."""
