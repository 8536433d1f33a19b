"""WISE: simulated pairs, the tables and figures of its distortion report, and its files."""
