"""Positions on the sky: at the epoch of an exposure, as the Earth sees them, on a tangent plane."""
