"""WISE: matched pairs of band-frame and 2MASS positions, from the published distortion."""

from bayesdist.missions.wise.simulate.files import write_wise_set
from bayesdist.missions.wise.simulate.published import (
    FORMAL_RADII,
    LARGEST_CORRECTIONS,
    LONGEST_VECTORS,
    RADIAL_RESIDUALS,
    RESIDUAL_SIGMAS,
    SAMPLE_SIZES,
    WISE_ARRAYS,
    WISE_BANDS,
    WISE_COEFFICIENTS,
)
from bayesdist.missions.wise.simulate.sets import PairChunk, WiseSet, wise_set
from bayesdist.missions.wise.simulate.solution import (
    simulate_wise,
    simulate_wise_partitioned,
    wise_solution,
)
from bayesdist.missions.wise.simulate.stars import POPULATIONS

__all__ = [
    "FORMAL_RADII",
    "LARGEST_CORRECTIONS",
    "LONGEST_VECTORS",
    "POPULATIONS",
    "RADIAL_RESIDUALS",
    "RESIDUAL_SIGMAS",
    "SAMPLE_SIZES",
    "WISE_ARRAYS",
    "WISE_BANDS",
    "WISE_COEFFICIENTS",
    "PairChunk",
    "WiseSet",
    "simulate_wise",
    "simulate_wise_partitioned",
    "wise_set",
    "wise_solution",
    "write_wise_set",
]
