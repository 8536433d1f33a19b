"""WISE: matched pairs of band-frame and 2MASS positions, from the published distortion."""

from bayesdist.simulate.wise.files import write_wise_set
from bayesdist.simulate.wise.published import (
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
from bayesdist.simulate.wise.sets import PairChunk, WiseSet, wise_set
from bayesdist.simulate.wise.solution import simulate_wise, wise_solution
from bayesdist.simulate.wise.stars import POPULATIONS

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
    "wise_set",
    "wise_solution",
    "write_wise_set",
]
