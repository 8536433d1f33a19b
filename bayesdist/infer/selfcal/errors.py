"""Errors of the detections by magnitude, from their scatter about their stars."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.selfcal.normal import Mixture, memberships
from bayesdist.infer.selfcal.problem import Problem

__all__ = ["MOST_TAKEN", "scatter_by_magnitude"]

Float = NDArray[np.float64]

LEAST = 200  # smallest number of detections in a bin
MOST_BINS = 20
# of a residual's variance: a star with as many parameters as detections absorbs it all
MOST_TAKEN = 0.99


def scatter_by_magnitude(
    problem: Problem, theta: Float, mixture: Mixture, stars: Float, mag: Float
) -> tuple[Float, Float]:
    """Median magnitude of each bin (bins,), and error on one axis there in pixels (bins,).

    A star's position is that of its own detections; the scatter is corrected for this.  `mag` (N,)
    is in the order of the problem.
    """
    w = memberships(problem, theta, mixture, stars)
    precision = w / (problem.var + mixture.jitter**2)
    total = np.bincount(problem.star, precision, minlength=problem.n_stars)[problem.star]
    # on each axis a star takes q / 2 degrees of freedom, shared by weight
    left = 1.0 - np.minimum(precision / np.maximum(total, 1e-300) * problem.n_star / 2, MOST_TAKEN)
    square = problem.squares(theta, stars)
    n_bins = int(np.clip(len(mag) // LEAST, 1, MOST_BINS))
    # equal magnitudes, as in lists without any, leave fewer bins
    edges = np.unique(np.quantile(mag, np.linspace(0, 1, n_bins + 1)))
    n_bins = max(len(edges) - 1, 1)
    bin_of = np.clip(np.searchsorted(edges, mag, side="right") - 1, 0, n_bins - 1)
    number = np.bincount(bin_of, w * left, n_bins)
    variance = np.bincount(bin_of, w * square, n_bins) / (2 * np.maximum(number, 1e-9))
    middles = np.array([np.median(mag[bin_of == k]) for k in range(n_bins)])
    return middles, np.sqrt(variance)
