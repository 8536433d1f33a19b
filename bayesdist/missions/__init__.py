"""Missions: each uses the core from outside, as anybody's own instrument would."""
