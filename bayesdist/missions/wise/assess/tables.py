"""Tables 5-1, 5-2 and 5-3 of WSDC D-T033, each statistic with its error."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations, product

import numpy as np

from bayesdist.diagnose.residuals.binned import BAND_AXES, BinnedSums
from bayesdist.diagnose.residuals.rows import bin_row, pair_row
from bayesdist.diagnose.residuals.tables import StatisticsTable

_AXES = BAND_AXES[:2]


def residual_tables(
    bands: Mapping[str, BinnedSums],
    *,
    rng: np.random.Generator,
    arcsec: Mapping[str, float],
    absorbed: Mapping[str, int],
) -> dict[str, StatisticsTable]:
    """Tables of several bands, in their order, by '5-1', '5-2' and '5-3'.

    5-1 has the residuals of the fit in bins, in pixels; 5-2, of two bands or more, the differences
    of two bands bin by bin, and 5-3 those over all pairs of bins of a band, both in arcsec.  Errors
    of two bands count as independent.  Where both use the same catalogue stars in the same frames
    they are not: the catalogue's errors cancel in the difference, its noise is smaller than said
    here, and its noise-free part larger.

    `bands`: as many bins of each, over the same field. `rng` is for the errors. `arcsec`: per pixel
    of each band. `absorbed` are the coefficients of one axis that the fit took out of the
    residuals: 15 at order 4; 1 where they are of a model that was not fitted to these stars. Raises
    DegenerateError when too few bins of a band hold two stars.
    """
    pixels = {(name, axis): bands[name].values(axis) for name, axis in product(bands, BAND_AXES)}
    scaled = {(name, axis): one.scaled(arcsec[name]) for (name, axis), one in pixels.items()}
    fitting = tuple(
        # the scatter of single stars is not what the coefficients are fitted to
        bin_row(f"{name}/{axis}", one, absorbed=1 if axis == "radial" else absorbed[name], rng=rng)
        for (name, axis), one in pixels.items()
    )
    between = tuple(
        bin_row(
            f"{later}-{earlier}/{axis}",
            scaled[later, axis].minus(scaled[earlier, axis]),
            absorbed=max(absorbed[earlier], absorbed[later]),
            rng=rng,
        )
        for (earlier, later), axis in product(combinations(bands, 2), _AXES)
    )
    all_pairs = tuple(
        pair_row(f"{name}/{axis}", scaled[name, axis], absorbed=absorbed[name], rng=rng)
        for name, axis in product(bands, _AXES)
    )
    aligned = "Single-frameset band-to-band alignment residuals"
    within = "In-band multiframe alignment residuals"
    tables = {
        "5-1": StatisticsTable("Distortion fitting residuals", "Band/Axis", "pix", fitting),
        "5-2": StatisticsTable(aligned, "Bands/Axis", "arcsec", between),
        "5-3": StatisticsTable(within, "Band/Axis", "arcsec", all_pairs),
    }
    return {name: table for name, table in tables.items() if table.rows}
