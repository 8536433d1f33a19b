"""What belongs to one mission: it uses the core from outside, as anybody's own instrument would."""
