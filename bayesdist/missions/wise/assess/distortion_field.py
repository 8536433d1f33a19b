"""Distortion as a vector field in detector pixels, and residuals with and without it.

The bands observe the same field of view.  Fields of two bands are compared at the same relative
position on their arrays, with the vectors converted to pixels of the first band.  Section 4 of
WSDC D-T033 shows the improvement by a calibration with histograms of the residuals of all stars
with the calibration, with other models, and with none.  All are computed from the same residuals,
by adding the distortion or the difference from another model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike

from bayesdist.assess.solution import place_of
from bayesdist.assess.vectors import VectorMap, distortion_vectors
from bayesdist.diagnose.residuals.binned import BinnedSums, band_bins
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.stars.likelihood import Clip
from bayesdist.infer.stars.stars import Stars, Sums
from bayesdist.model import PolynomialBasis
from bayesdist.model.grid import grid_pixels
from bayesdist.utils.arrays import Float, Int

CALIBRATED = "calibrated"
HISTOGRAM_BINS = 401  # odd, so that one bin is centred on zero
_BLOCK = 2**16  # stars that are processed together


@dataclass(frozen=True, eq=False)
class DistortionField:
    """Vectors from detector positions to undistorted positions, zero at the reference pixel."""

    basis: PolynomialBasis
    polynomial: Float  # (2, K), Legendre coefficients of the vectors along x and y, pixels
    to_pixels: Float  # (2, 2), converts offsets in (u, v) of the solution to pixels along x and y

    @classmethod
    def of(cls, basis: PolynomialBasis, polynomial: Float, to_pixels: Float) -> DistortionField:
        """Field from a polynomial (2, K), with its value at the reference pixel subtracted."""
        polynomial = np.array(polynomial, float)
        x, y = basis.reference_pixel
        polynomial[:, 0] -= polynomial @ basis.evaluate([x], [y])[0]
        return cls(basis, polynomial, to_pixels)

    def at_scaled(self, X: ArrayLike, Y: ArrayLike) -> Float:
        """Vectors (2, ...) at scaled coordinates, from -1 to 1 over the array on both axes."""
        X, Y = np.asarray(X, float), np.asarray(Y, float)
        order = self.basis.order
        square = np.zeros((2, order + 1, order + 1))
        square[:, *np.array(self.basis.terms).T] = self.polynomial
        return np.stack(
            [np.asarray(legendre.legval2d(X, Y, coefficients), float) for coefficients in square]
        )

    def minus(self, other: DistortionField, ratio: float = 1.0) -> DistortionField:
        """Difference from another field that covers the same part of the sky.

        `ratio` is the pixel scale of the other array relative to that of this array.  The result is
        in pixels of this array.
        """
        basis = max((self.basis, other.basis), key=lambda b: b.order)
        # terms of lower order come first, and Legendre products depend only on the relative
        # position on the array
        this_polynomial, other_polynomial = (
            np.pad(f.polynomial, ((0, 0), (0, basis.n_terms - f.basis.n_terms)))
            for f in (self, other)
        )
        common_basis = replace(self.basis, order=basis.order)
        return DistortionField(
            common_basis, this_polynomial - ratio * other_polynomial, self.to_pixels
        )

    def vectors(self, grid: tuple[int, int]) -> VectorMap:
        """Vectors in pixels on a grid (nx, ny) from the first to the last pixel."""
        x, y = grid_pixels(self.basis.size, grid)
        du, dv = self.at_scaled(*np.meshgrid(*self.basis.scaled(x, y)))
        return VectorMap(x, y, du, dv, "pix", "no_constant")


def field_of_solution(solution: Solution, *, epoch: float | None = None) -> DistortionField:
    """Distortion of the first chip for the mean of a solution; see `distortion_vectors`.

    `epoch` is in decimal years, and required for a model with time dependence.
    """
    place = place_of(solution.model, epoch=epoch)
    similarity = distortion_vectors(solution, grid=(2, 2), epoch=epoch).similarity
    to_pixels = np.asarray(np.linalg.inv(similarity), float)
    basis = place.basis
    polynomial = to_pixels @ place.polynomial(solution.mean)
    # subtract the detector position: half the size times P_1 along each axis
    polynomial[:, 1:3] -= np.diag(basis.half_size)
    return DistortionField.of(basis, polynomial, to_pixels)


@dataclass(frozen=True, eq=False)
class ResidualHistogram(Sums):
    """Counts of the residuals along x and y; histograms of parts of the data can be added."""

    SAME = ("reach",)

    reach: float  # the range of the bins is from -reach to reach, pixels
    counts: Int  # (2, B)
    outside: Int  # (2,), number of residuals outside of the bins

    @property
    def edges(self) -> Float:
        """Edges (B + 1,) of the bins, pixels."""
        return np.linspace(-self.reach, self.reach, self.counts.shape[1] + 1)

    @property
    def n(self) -> int:
        """Number of stars, including those outside of the bins."""
        return int(self.counts[0].sum() + self.outside[0])

    def half_width(self) -> Float:
        """Half the width (2,) of the central interval that contains 68.27 % of the residuals.

        For normal residuals it equals sigma, and it is insensitive to false matches.  It is
        interpolated within bins, and infinite if a limit of the interval is outside of the bins.
        """
        out = np.full(2, np.inf)
        for axis, (counts, beyond) in enumerate(zip(self.counts, self.outside, strict=True)):
            # assign half of the residuals outside to either side
            cumulative = (np.concatenate([[0], np.cumsum(counts)]) + beyond / 2) / max(self.n, 1)
            low, high = (1 - 0.6827) / 2, (1 + 0.6827) / 2
            if cumulative[0] < low and cumulative[-1] > high:
                a, b = np.interp([low, high], cumulative, self.edges)
                out[axis] = (b - a) / 2
        return out


def histogram(residual: Float, reach: float, bins: int = HISTOGRAM_BINS) -> ResidualHistogram:
    """Histogram of residuals (2, N) along x and y, in pixels."""
    counts, outside = [], []
    for values in residual:
        inside = values[np.abs(values) < reach]
        index = ((inside + reach) * (bins / (2 * reach))).astype(np.int64)
        counts.append(np.bincount(np.minimum(index, bins - 1), minlength=bins))
        outside.append(values.size - inside.size)
    return ResidualHistogram(float(reach), np.stack(counts), np.array(outside))


@dataclass(frozen=True, eq=False)
class BandSums(Sums):
    """Binned sums and histograms of the stars of a band; parts of the data can be added."""

    bins: BinnedSums  # of the stars that were used in the fit, pixels
    # of all stars, by model; `CALIBRATED` is the calibration
    histograms: Mapping[str, ResidualHistogram]


def band_sums(
    stars: Stars,
    theta: Float,
    clip: Clip,
    to_pixels: Float,
    without: Mapping[str, DistortionField],
    reach: float,
    bins: int,
) -> BandSums:
    """Binned sums and histograms of stars of one chip; a task for `Shards.sum`.

    Parameters
    ----------
    stars : Stars
    theta : ndarray, shape (D,)
    clip : Clip
        Rejection limits of the fit.
    to_pixels : ndarray, shape (2, 2)
        Converts residuals to pixels along x and y.
    without : mapping of str to DistortionField
        Fields that are added to the residuals for the other histograms: the distortion itself for
        no correction, or its difference from another model.
    reach : float
        Range of the histograms, pixels.
    bins : int
        Number of bins per axis for the binned sums.
    """
    residual = to_pixels @ stars.residuals(theta).T
    used = clip.keeps_of(stars)
    columns = (*stars.pixels(), *residual)
    of_bins = band_bins(*(c[used] for c in columns), bins=bins, size=stars.model.chips[0].size)
    histograms = {CALIBRATED: histogram(residual, reach)}
    for name, field in without.items():
        parts = [slice(k, k + _BLOCK) for k in range(0, max(len(stars), 1), _BLOCK)]
        first, *further = (
            histogram(residual[:, p] + field.at_scaled(stars.X[p], stars.Y[p]), reach)
            for p in parts
        )
        histograms[name] = sum(further, first)
    return BandSums(of_bins, histograms)
