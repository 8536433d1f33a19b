"""Tables 5-1, 5-2 and 5-3 of WSDC D-T033, each statistic with its error."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations, product

import numpy as np

from bayesdist.diagnose.residuals.binned import BAND_AXES, BinnedSums, BinValues
from bayesdist.diagnose.residuals.rows import bin_row, pair_row
from bayesdist.diagnose.residuals.tables import StatisticsTable
from bayesdist.missions.wise.published import WISE_ARRAYS

_AXES = BAND_AXES[:2]
WISE_ARCSEC = {band: array.scale for band, array in WISE_ARRAYS.items()}  # per pixel


def fitting_table(
    bands: Mapping[str, BinnedSums], *, rng: np.random.Generator, absorbed: int = 1
) -> StatisticsTable:
    """Table 5-1: residuals of the fit in bins, in pixels.

    Bands are in the order of the table, `rng` is for the errors. `absorbed` are the coefficients of
    one axis that the fit took out of the residuals: 15 at order 4; 1 where the residuals are of a
    model that was not fitted to these stars. Raises DegenerateError when too few bins of a band
    hold two stars.
    """
    rows = tuple(
        # the scatter of single stars is not what the coefficients are fitted to
        bin_row(
            f"{name}/{axis}",
            band.values(axis),
            absorbed=1 if axis == "radial" else absorbed,
            rng=rng,
        )
        for name, band in bands.items()
        for axis in BAND_AXES
    )
    return StatisticsTable("Distortion fitting residuals", "Band/Axis", "pix", rows)


def band_to_band_table(
    bands: Mapping[str, BinnedSums],
    *,
    rng: np.random.Generator,
    absorbed: int = 1,
    arcsec: Mapping[str, float] = WISE_ARCSEC,
) -> StatisticsTable:
    """Table 5-2: differences of two bands bin by bin, in arcsec.

    Errors of two bands count as independent.  Where both use the same catalogue stars in the same
    frames they are not: the catalogue's errors cancel in the difference, its noise is smaller than
    said here, and its noise-free part larger.

    As `fitting_table`, of two bands or more; the bins of all are as many and cover the same field,
    `arcsec` are those per pixel of each band.
    """
    values = _in_arcsec(bands, arcsec)
    rows = tuple(
        bin_row(
            f"{later}-{earlier}/{axis}",
            values[later, axis].minus(values[earlier, axis]),
            absorbed=absorbed,
            rng=rng,
        )
        for earlier, later, axis in _two_bands(bands)
    )
    title = "Single-frameset band-to-band alignment residuals"
    return StatisticsTable(title, "Bands/Axis", "arcsec", rows)


def multiframe_table(
    bands: Mapping[str, BinnedSums],
    *,
    rng: np.random.Generator,
    absorbed: int = 1,
    arcsec: Mapping[str, float] = WISE_ARCSEC,
) -> StatisticsTable:
    """Table 5-3: differences over all pairs of bins, in arcsec.

    As `band_to_band_table`, of one band or more.
    """
    values = _in_arcsec(bands, arcsec)
    rows = tuple(
        pair_row(f"{name}/{axis}", values[name, axis], absorbed=absorbed, rng=rng)
        for name, axis in values
    )
    title = "In-band multiframe alignment residuals"
    return StatisticsTable(title, "Band/Axis", "arcsec", rows)


def _two_bands(bands: Iterable[str]) -> Iterator[tuple[str, str, str]]:
    """Iterator over every band with every later one, on each axis."""
    for (earlier, later), axis in product(combinations(bands, 2), _AXES):
        yield earlier, later, axis


def _in_arcsec(
    bands: Mapping[str, BinnedSums], arcsec: Mapping[str, float]
) -> dict[tuple[str, str], BinValues]:
    return {
        (name, axis): band.values(axis).scaled(arcsec[name])
        for name, band in bands.items()
        for axis in _AXES
    }
