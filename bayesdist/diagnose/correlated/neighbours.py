"""Structure finer than the functions, from products of neighbouring stars' scores.

A pattern of a few tens of pixels is hardly different from white noise for all functions that the
stars can resolve, and yet stars that lie next to each other share it.  With scores g and curvatures
h of stars whose own errors are independent, a displacement with covariance C(d) at separation d
makes

    sum g_i g_j = C(d) sum h_i h_j

on the mean over pairs, but for the parts that the fit has absorbed and that are smooth.  Both are
the same for pairs a little farther apart, so that only the difference to these is used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from bayesdist.data.matches import Matches
from bayesdist.data.repeated_stars import error_codes
from bayesdist.infer.stars.likelihood import Likelihood
from bayesdist.infer.stars.stars import prepare
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int

# of separations, in pixels; the last bin is of pairs farther apart
EDGES = np.array([0.0, 6.0, 12.0, 24.0, 48.0, 96.0])
MAX_PAIRS = 2_000_000
SHAPE = 0.3  # by which the correlation at a separation may differ: patterns are periodic
MIN_PAIRS = 50  # of a bin; the variance of fewer cannot be estimated


@dataclass(frozen=True, eq=False)
class SharedVariance:
    """Covariance of displacements of neighbouring stars, on one axis of a chip."""

    separation: Float  # mean (b,) of each bin, in longer half sides of the chip
    apart: float  # mean separation of the pairs farther apart
    # (b,) in excess of that of the pairs farther apart, in the squared unit of u, v
    covariance: Float
    variance: Float  # (b,) of the covariance, by the scatter of the products

    def of_field(self, length: float) -> Callable[[float], float]:
        """Log likelihood of a Matern field's amplitude, by its correlation length in half sides."""
        at_unit = _matern(self.separation / length) - _matern(np.array(self.apart / length))

        def log_likelihood(amplitude: float) -> float:
            left = self.covariance - at_unit * amplitude**2
            variance = self.variance + (SHAPE * amplitude**2) ** 2
            return float(-0.5 * np.sum(left**2 / variance + np.log(variance / self.variance)))

        return log_likelihood


def _matern(separation: Float) -> Float:
    """Correlation of the field of `StructureFunctions`, by separation in correlation lengths."""
    z = np.sqrt(3.0) * separation
    return np.asarray((1 + z) * np.exp(-z))


def shared_variances(
    table: Matches, likelihood: Likelihood, model: DistortionModel
) -> dict[int, tuple[SharedVariance | None, SharedVariance | None]]:
    """Evidence of neighbouring stars on the two axes of each chip, by its code.

    The matches are those of the solution with this likelihood, or some of them.  A star that is
    matched several times is no neighbour of itself: its catalogue position has one error.  Stars of
    a tight group are no neighbours of each other either.  None for an axis with too few pairs.
    """
    stars, order = prepare(model, table)
    g_u, g_v, h_uu, h_uv, h_vv = likelihood.scores(stars)
    shared = error_codes(table.u, table.v, table.star)
    code = np.arange(len(order)) if shared is None else shared[order]
    g = np.stack([g_u, g_v], axis=1)
    h = np.stack([h_uu, h_uv, h_uv, h_vv], axis=1).reshape(-1, 2, 2)
    good = (h_uu > 0) & (h_vv > 0)
    chip = np.full(len(order), -1)
    for k, (c, exposure) in enumerate(zip(stars.groups.chip, stars.groups.exposure, strict=True)):
        rows = slice(stars.starts[k], stars.starts[k + 1])
        frame = np.asarray(model.frame(likelihood.theta, int(exposure))[0])
        g[rows] = g[rows] @ frame
        h[rows] = frame.T @ h[rows] @ frame
        chip[rows] = c
    out = {}
    for c, one in enumerate(model.chips):
        here = np.flatnonzero((chip == c) & good)
        expected = len(here) ** 2 * np.pi * EDGES[-1] ** 2 / (2 * one.size[0] * one.size[1])
        here = here[:: max(1, round(float(np.sqrt(expected / MAX_PAIRS))))]
        at = np.column_stack([stars.X[here] * one.size[0], stars.Y[here] * one.size[1]]) / 2
        pairs = cKDTree(at).query_pairs(EDGES[-1], output_type="ndarray")
        star = np.unique(code[here], return_inverse=True)[1]
        pairs = pairs[star[pairs[:, 0]] != star[pairs[:, 1]]]
        separation = np.linalg.norm(at[pairs[:, 0]] - at[pairs[:, 1]], axis=1)
        half = max(one.size) / 2
        # pairs of detections of the same two stars repeat one product of their errors
        of_stars = None if len(star) == star.max(initial=-1) + 1 else star[pairs]
        u, v = (
            _shared(g[here, a], h[here, a, a], pairs, separation, half, of_stars) for a in (0, 1)
        )
        out[c] = u, v
    return out


def _shared(
    g: Float, h: Float, pairs: Int, separation: Float, half: float, stars: Int | None
) -> SharedVariance | None:
    """Excess covariance by pairs (n, 2) of detections; `stars` (n, 2) are theirs, if repeated."""
    bins = np.clip(np.searchsorted(EDGES, separation, side="right") - 1, 0, len(EDGES) - 2)
    i, j = pairs.T
    product, weight = g[i] * g[j], h[i] * h[j]
    if stars is not None and len(stars):
        first, second = np.sort(stars, axis=1).T
        keys = (first * (int(stars.max()) + 1) + second) * len(EDGES) + bins
        keys, of = np.unique(keys, return_inverse=True)
        bins = keys % len(EDGES)
        separation = np.bincount(of, separation) / np.bincount(of)
        product, weight = np.bincount(of, product), np.bincount(of, weight)
    count, total, together, distance = (
        np.bincount(bins, w, minlength=len(EDGES) - 1).astype(float)
        for w in (None, weight, product, separation)
    )
    # without informative pairs there is no comparison
    if count[-1] < MIN_PAIRS or not (total > 0).all():
        return None
    mean = together / np.maximum(total, 1e-300)
    scatter = np.bincount(bins, (product - mean[bins] * weight) ** 2, minlength=len(count))
    variance = scatter / np.maximum(total, 1e-300) ** 2
    some = np.flatnonzero(count[:-1] >= MIN_PAIRS)
    if not some.size:
        return None
    distance = distance / np.maximum(count, 1) / half
    return SharedVariance(
        distance[some],
        float(distance[-1]),
        mean[some] - mean[-1],
        variance[some] + variance[-1],
    )
