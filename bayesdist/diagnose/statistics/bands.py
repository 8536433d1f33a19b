"""Residuals of a band in bins of its array: X, Y and radial, as section 5 of WSDC D-T033."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.diagnose.residuals.binned import BinnedSums, binned_sums
from bayesdist.diagnose.statistics.rows import BinValues
from bayesdist.names import require_known

__all__ = ["BAND_AXES", "WISE_ARCSEC", "BandBins", "band_bins"]

Float = NDArray[np.float64]

BAND_AXES = ("X", "Y", "radial")
WISE_ARCSEC = {"W1": 2.75, "W2": 2.75, "W3": 2.75, "W4": 5.5}  # per pixel; W4 is binned 2 x 2


@dataclass(frozen=True, eq=False)
class BandBins:
    """Sums of residuals in bins; those of pieces of the data add.

    Parameters
    ----------
    axes : BinnedSums
        Of the residuals in u and v.
    radial : BinnedSums
        Of their length, star by star (u and v of the sums hold the same): the mean length of a
        bin tells of the scatter of single stars, not of the length of the mean residual.
    """

    axes: BinnedSums
    radial: BinnedSums

    def __add__(self, other: BandBins) -> BandBins:
        return BandBins(self.axes + other.axes, self.radial + other.radial)

    def values(self, axis: str) -> BinValues:
        """Means of the bins.

        Parameters
        ----------
        axis : str
            One of `BAND_AXES`.

        Returns
        -------
        BinValues

        Raises
        ------
        InputError
            For an unknown axis.
        """
        require_known(axis, BAND_AXES, "axis")
        bins = (self.radial if axis == "radial" else self.axes).residuals()
        mean, sem = (bins.mean_v, bins.sem_v) if axis == "Y" else (bins.mean_u, bins.sem_u)
        return BinValues(mean, sem, np.maximum(bins.count - 1.0, 0.0))


def band_bins(
    x: ArrayLike,
    y: ArrayLike,
    ru: ArrayLike,
    rv: ArrayLike,
    *,
    bins: int | tuple[int, int] = 31,
    size: tuple[float, float],
    weights: ArrayLike | None = None,
) -> BandBins:
    """Residuals of a band in bins.

    Parameters
    ----------
    x, y, ru, rv, size, weights
        As `bayesdist.assess.binned_sums`; residuals in pixels of the band.
    bins : int or tuple of int
        31 in section 5 of WSDC D-T033, 45 in its Appendix C.

    Returns
    -------
    BandBins

    Raises
    ------
    InputError
        As `bayesdist.assess.binned_sums`.
    """
    ru, rv = np.asarray(ru, float), np.asarray(rv, float)
    axes = binned_sums(x, y, ru, rv, bins=bins, size=size, weights=weights)
    length = np.hypot(ru, rv)
    return BandBins(axes, binned_sums(x, y, length, length, bins=bins, size=size, weights=weights))
