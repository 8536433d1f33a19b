"""Data sets of known truth."""

from bayesdist.simulate.matches import Truth, simulate_matches, simulate_partitioned

__all__ = ["Truth", "simulate_matches", "simulate_partitioned"]
