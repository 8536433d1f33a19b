"""Simulated data sets with known truth."""

from bayesdist.simulate import Truth, simulate_matches, simulate_partitioned

__all__ = ["Truth", "simulate_matches", "simulate_partitioned"]
