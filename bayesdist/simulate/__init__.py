"""Data sets of known truth."""

from bayesdist.simulate.acs import (
    AcsCampaign,
    AcsTruth,
    acs_solution,
    read_acs,
    simulate_acs,
    write_acs,
)
from bayesdist.simulate.matches import Truth, simulate_matches
from bayesdist.simulate.partitioned import simulate_wise_partitioned
from bayesdist.simulate.wise import simulate_wise, wise_solution

__all__ = [
    "AcsCampaign",
    "AcsTruth",
    "Truth",
    "acs_solution",
    "read_acs",
    "simulate_acs",
    "simulate_matches",
    "simulate_wise",
    "simulate_wise_partitioned",
    "wise_solution",
    "write_acs",
]
