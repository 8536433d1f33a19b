"""Data sets of known truth."""

from bayesdist.simulate.matches import Truth, simulate_matches
from bayesdist.simulate.partitioned import simulate_wise_partitioned
from bayesdist.simulate.wise import simulate_wise, wise_solution

__all__ = [
    "Truth",
    "simulate_matches",
    "simulate_wise",
    "simulate_wise_partitioned",
    "wise_solution",
]
