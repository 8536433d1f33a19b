"""Structure finer than the functions, from products of the scores of neighbouring stars.

For the functions that the stars can resolve, a pattern of a few tens of pixels is hardly different
from white noise, but neighbouring stars share it.  For stars with independent errors, scores g and
curvatures h, a displacement with the covariance C(d) at the separation d gives

    sum g_i g_j = C(d) sum h_i h_j

on average over pairs.  The part that the functions resolve is subtracted from the scores first.
With its posterior mean f and covariance S at the stars,

    C(d) sum h_i h_j = sum [(g_i - h_i f_i) (g_j - h_j f_j) + h_i h_j S_ij]

so that C is the covariance of the finer structure.  Remainders of smoother structure are the same
for pairs at slightly larger separations; only the difference to these is used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import j0

from bayesdist.data.matches import Matches
from bayesdist.diagnose.correlated.information import scores_on_chips
from bayesdist.infer.stars.likelihood import Likelihood
from bayesdist.infer.stars.stars import prepare
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.matern import matern

# of separations, in pixels; the last bin contains the pairs used for comparison
EDGES = np.array([0.0, 6.0, 12.0, 24.0, 48.0, 96.0])
MAX_PAIRS = 2_000_000
SHAPE = 0.3  # relative tolerance of the correlation at a separation, because patterns are periodic
# number of pairs over which the uncertainty of the resolved structure is averaged
MAX_COMPARED = 20_000
MIN_PAIRS = 50  # per bin; with fewer, the variance cannot be estimated

NODES, WEIGHTS = np.polynomial.legendre.leggauss(64)


@dataclass(frozen=True, eq=False)
class SharedVariance:
    """Covariance of displacements of neighbouring stars, on one axis of a chip."""

    separation: Float  # (b,) mean of each bin, in longer half sides of the chip
    apart: float  # mean separation of the pairs used for comparison
    # (b,) in excess of that of the comparison pairs, in the squared unit of u and v
    covariance: Float
    variance: Float  # (b,) variance of the covariance, from the scatter of the products
    bins: Int  # (b,) index of each bin in `EDGES`

    def raised(self, by: Float) -> SharedVariance:
        """Evidence with the covariances `by` in all bins of `EDGES` added."""
        return replace(self, covariance=self.covariance + by[self.bins] - by[-1])

    def of_field(self, length: float, cut: float = 0.0) -> Callable[[float], float]:
        """Log-likelihood of a Matern field as a function of its amplitude.

        `length` is the correlation length in half sides.  Only the part of the field at angular
        frequencies above `cut` (inverse half sides) is considered.
        """
        separation = np.append(self.separation, self.apart)
        at = matern(separation / length) - _below(cut, length, separation)
        at_unit = at[:-1] - at[-1]
        # The correlation of a pattern may differ from that of the field by SHAPE of its variance.
        # The tolerance does not grow beyond the most likely size: otherwise its growth alone would
        # favour smaller amplitudes.
        weight = at_unit / self.variance
        likely = max(float(weight @ self.covariance / max(weight @ at_unit, 1e-300)), 0.0)
        finer = float((1 + cut**2 * length**2 / 3) ** -1.5)

        def log_likelihood(amplitude: float) -> float:
            deviation = self.covariance - at_unit * amplitude**2
            tolerance = SHAPE * finer * min(amplitude**2, likely)
            variance = self.variance + tolerance**2
            return float(-0.5 * np.sum(deviation**2 / variance + np.log(variance / self.variance)))

        return log_likelihood


def _below(cut: float, length: float, separation: Float) -> Float:
    """Covariance, at given separations, of a unit-variance field at frequencies below `cut`.

    This is the integral of J0(k d) over the spectral density of the Matern field in two dimensions.
    """
    k, weight = (NODES + 1) * cut / 2, WEIGHTS * cut / 2
    k2 = 3 / length**2
    density = 3 * k * k2**1.5 * (k2 + k**2) ** -2.5
    return np.asarray(j0(np.outer(separation, k)) @ (weight * density))


def shared_variances(
    table: Matches, likelihood: Likelihood, model: DistortionModel
) -> dict[int, tuple[SharedVariance | None, SharedVariance | None]]:
    """Evidence of neighbouring stars on both axes of each chip, by the code of the chip.

    Nothing is subtracted from the scores.  The matches are those of the solution with this
    likelihood, or a part of them.  Pairs of matches of one star, or of stars in a tight group, are
    excluded because they share an error of the reference position.  The evidence is None for an
    axis with too few pairs.
    """
    return {
        code: chip.shared_variances()
        for code, chip in neighbour_scores(table, likelihood, model).items()
    }


@dataclass(frozen=True, eq=False)
class NeighbourScores:
    """Stars of one chip, with their scores along the axes of the polynomials."""

    X: Float  # X, Y (n,): scaled positions
    Y: Float
    score: Float  # (n, 2) gradient of the log-likelihood
    curvature: Float  # (n, 2, 2) minus its second derivatives
    # (n,) code of the star, or tight group of stars, that shares an error of the reference, from 0
    star: Int
    pairs: Int  # (p, 2) indices of neighbours that are different stars
    separation: Float  # (p,) in pixels
    half: float  # longer half side of the chip, in pixels

    def shared_variances(
        self, resolved: Float | None = None
    ) -> tuple[SharedVariance | None, SharedVariance | None]:
        """Evidence on both axes.

        `resolved` (draws, n, 2) are draws of the structure that the functions resolve.
        """
        single = len(self.star) == self.star.max(initial=-1) + 1
        of_stars = None if single else self.star[self.pairs]
        score, bins = self.score, _bins(self.separation)
        if resolved is not None:
            score = score - np.einsum("nab,nb->na", self.curvature, resolved.mean(axis=0))
        out = []
        for a in (0, 1):
            h = self.curvature[:, a, a]
            shared = _shared(score[:, a], h, self.pairs, self.separation, self.half, of_stars, bins)
            if shared is not None and resolved is not None:
                shared = shared.raised(self._uncertain(resolved[..., a], h, bins))
            out.append(shared)
        return out[0], out[1]

    def _uncertain(self, resolved: Float, h: Float, bins: Int) -> Float:
        """Mean covariance per bin of the resolved structure's uncertainty, from draws (d, n)."""
        selected = slice(None, None, max(1, len(self.pairs) // MAX_COMPARED))
        i, j = self.pairs[selected].T
        # divided by the number of draws, because the subtracted mean is that of the same draws
        deviation = (resolved - resolved.mean(axis=0)).T
        weight = h[i] * h[j]
        product = np.einsum("pd,pd->p", deviation[i], deviation[j]) / len(resolved)
        n = len(EDGES) - 1
        total, sums = (np.bincount(bins[selected], w, n) for w in (weight, weight * product))
        return np.asarray(sums / np.maximum(total, 1e-300))


def neighbour_scores(
    table: Matches, likelihood: Likelihood, model: DistortionModel
) -> dict[int, NeighbourScores]:
    """Scores of neighbouring stars of each chip, by its code.

    For the arguments see `shared_variances`.
    """
    stars, order = prepare(model, table)
    code = np.arange(len(order)) if table.error_codes is None else table.error_codes[order]
    g, h, chip = scores_on_chips(model, stars, likelihood)
    out = {}
    for c, model_chip in enumerate(model.chips):
        members = np.flatnonzero(chip == c)
        expected = (
            len(members) ** 2
            * np.pi
            * EDGES[-1] ** 2
            / (2 * model_chip.size[0] * model_chip.size[1])
        )
        members = members[:: max(1, round(float(np.sqrt(expected / MAX_PAIRS))))]
        at = (
            np.column_stack(
                [stars.X[members] * model_chip.size[0], stars.Y[members] * model_chip.size[1]]
            )
            / 2
        )
        pairs = cKDTree(at).query_pairs(EDGES[-1], output_type="ndarray")
        star = np.unique(code[members], return_inverse=True)[1]
        pairs = pairs[star[pairs[:, 0]] != star[pairs[:, 1]]]
        separation = np.linalg.norm(at[pairs[:, 0]] - at[pairs[:, 1]], axis=1)
        half = max(model_chip.size) / 2
        X, Y = stars.X[members], stars.Y[members]
        out[c] = NeighbourScores(X, Y, g[members], h[members], star, pairs, separation, half)
    return out


def _bins(separation: Float) -> Int:
    """Index of the bin of each separation."""
    return np.clip(np.searchsorted(EDGES, separation, side="right") - 1, 0, len(EDGES) - 2)


def _shared(
    g: Float,
    h: Float,
    pairs: Int,
    separation: Float,
    half: float,
    stars: Int | None,
    bins: Int,
) -> SharedVariance | None:
    """Excess covariance from pairs (p, 2) of detections, in bins (p,) of their separations.

    `stars` (p, 2) are the stars of the detections, or None if each star has one detection: several
    pairs of detections of the same two stars repeat one product of their errors.
    """
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
    # without informative pairs no comparison is possible
    if count[-1] < MIN_PAIRS or not (total > 0).all():
        return None
    mean = together / np.maximum(total, 1e-300)
    scatter = np.bincount(bins, (product - mean[bins] * weight) ** 2, minlength=len(count))
    variance = scatter / np.maximum(total, 1e-300) ** 2
    filled = np.flatnonzero(count[:-1] >= MIN_PAIRS)
    if not filled.size:
        return None
    distance = distance / np.maximum(count, 1) / half
    return SharedVariance(
        distance[filled],
        float(distance[-1]),
        mean[filled] - mean[-1],
        variance[filled] + variance[-1],
        filled,
    )
