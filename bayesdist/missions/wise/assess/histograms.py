"""Histograms of the residuals of all stars with a calibration, other models, and none.

Section 4 of WSDC D-T033 uses such histograms to show the improvement by a calibration.  All are
computed from the same residuals, by adding the distortion or the difference from another model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bayesdist.diagnose.residuals.binned import BinnedSums, band_bins
from bayesdist.infer.stars.likelihood import Clip
from bayesdist.infer.stars.stars import Stars, Sums
from bayesdist.missions.wise.assess.distortion_field import DistortionField
from bayesdist.utils.arrays import Float, Int

CALIBRATED = "calibrated"
HISTOGRAM_BINS = 401  # odd, so that one bin is centred on zero
_BLOCK = 2**16  # stars that are processed together


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
