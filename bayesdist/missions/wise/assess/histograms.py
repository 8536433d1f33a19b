"""Residuals of all stars, counted in fixed bins: with a calibration, with others, and without.

Section 4 of WSDC D-T033 shows by such histograms what a calibration gains.  One residual gives them
all: without any correction it is longer by the distortion, with another model by the difference.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bayesdist.diagnose.residuals.binned import BinnedSums, band_bins
from bayesdist.infer.stars.likelihood import Clip
from bayesdist.infer.stars.stars import Stars
from bayesdist.infer.stars.sums import Sums
from bayesdist.missions.wise.assess.distortion_field import DistortionField
from bayesdist.utils.arrays import Float, Int

CALIBRATED = "calibrated"
HISTOGRAM_BINS = 401  # an odd number: one of them lies about zero
_BLOCK = 2**16  # stars


@dataclass(frozen=True, eq=False)
class ResidualHistogram(Sums):
    """Counts of the residuals along x and y; those of pieces of the data add."""

    SAME = ("reach",)

    reach: float  # the bins run evenly from -reach to reach, in pixels
    counts: Int  # (2, B)
    outside: Int  # (2,), residuals beyond

    @property
    def edges(self) -> Float:
        """Edges of the bins (B + 1,), pixels."""
        return np.linspace(-self.reach, self.reach, self.counts.shape[1] + 1)

    @property
    def n(self) -> int:
        """Stars, those beyond the bins included."""
        return int(self.counts[0].sum() + self.outside[0])

    def half_width(self) -> Float:
        """Half the width (2,) of the interval about the median that holds 68.27 % of the stars.

        For normal residuals it is sigma, whatever the share of false matches far away; interpolated
        within bins, and infinite where stars beyond the bins would decide.
        """
        out = np.full(2, np.inf)
        for axis, (counts, beyond) in enumerate(zip(self.counts, self.outside, strict=True)):
            # those beyond count as half on either side
            share = (np.concatenate([[0], np.cumsum(counts)]) + beyond / 2) / max(self.n, 1)
            low, high = (1 - 0.6827) / 2, (1 + 0.6827) / 2
            if share[0] < low and share[-1] > high:
                a, b = np.interp([low, high], share, self.edges)
                out[axis] = (b - a) / 2
        return out


def histogram(residual: Float, reach: float, bins: int = HISTOGRAM_BINS) -> ResidualHistogram:
    """Count residuals.

    `residual`: (2, N), along x and y, pixels.
    """
    counts, outside = [], []
    for values in residual:
        inside = values[np.abs(values) < reach]
        index = ((inside + reach) * (bins / (2 * reach))).astype(np.int64)
        counts.append(np.bincount(np.minimum(index, bins - 1), minlength=bins))
        outside.append(values.size - inside.size)
    return ResidualHistogram(float(reach), np.stack(counts), np.array(outside))


@dataclass(frozen=True, eq=False)
class BandSums(Sums):
    """Bins and histograms of one pass over the stars of a band; parts add."""

    bins: BinnedSums  # of the stars that the fit used, pixels
    # of all stars; that of the calibration under `CALIBRATED`
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
    """Bins and histograms of some stars of one chip: a task for `Shards.sum`.

    `to_pixels` (2, 2) takes residuals to pixels along x and y; `without` is what the residuals are
    longer by in another case: the distortion itself where nothing is corrected, or its difference
    from another model.
    """
    residual = to_pixels @ stars.residuals(theta).T
    used = clip.keeps_of(stars)
    columns = (*stars.pixels(), *residual)
    of_bins = band_bins(*(c[used] for c in columns), bins=bins, size=stars.model.chips[0].size)
    histograms = {CALIBRATED: histogram(residual, reach)}
    for name, field in without.items():
        parts = [slice(k, k + _BLOCK) for k in range(0, max(len(stars), 1), _BLOCK)]
        first, *others = (
            histogram(residual[:, p] + field.at_scaled(stars.X[p], stars.Y[p]), reach)
            for p in parts
        )
        histograms[name] = sum(others, first)
    return BandSums(of_bins, histograms)
