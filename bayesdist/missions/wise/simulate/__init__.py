"""Simulated WISE data: pairs of band-frame and 2MASS positions with the published distortion."""

from bayesdist.missions.wise.simulate.files import write_wise_set
from bayesdist.missions.wise.simulate.sets import POPULATIONS, PairChunk, WiseSet, wise_set
from bayesdist.missions.wise.simulate.solution import (
    simulate_wise,
    simulate_wise_partitioned,
    wise_solution,
)

__all__ = [
    "POPULATIONS",
    "PairChunk",
    "WiseSet",
    "simulate_wise",
    "simulate_wise_partitioned",
    "wise_set",
    "wise_solution",
    "write_wise_set",
]
