"""Data sets of known truth."""

from bayesdist.simulate.matches import Truth, simulate_matches
from bayesdist.simulate.wise import simulate_wise, wise_solution

__all__ = ["Truth", "simulate_matches", "simulate_wise", "wise_solution"]
