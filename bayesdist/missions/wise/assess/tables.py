"""Tables 5-1, 5-2 and 5-3 of WSDC D-T033 for any bands, with errors of all statistics."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations, product

import numpy as np

from bayesdist.diagnose.residuals.binned import BAND_AXES, BinnedSums
from bayesdist.diagnose.residuals.tables import StatisticsTable, bin_row, pair_row

_AXES = BAND_AXES[:2]


def residual_tables(
    bands: Mapping[str, BinnedSums],
    *,
    rng: np.random.Generator,
    arcsec: Mapping[str, float],
    absorbed: Mapping[str, int],
) -> dict[str, StatisticsTable]:
    """Residual tables '5-1', '5-2' and '5-3' of several bands.

    Table 5-1 has the residuals of the fit in bins, in pixels.  Table 5-2 has the differences of two
    bands bin by bin, and Table 5-3 the differences over all pairs of bins of a band, both in
    arcsec.  The errors of two bands are assumed to be independent.  If both use the same catalogue
    stars in the same frames, the errors of the catalogue cancel in the difference.  Its noise is
    then overestimated, and its noise-free part underestimated.

    Parameters
    ----------
    bands : mapping of str to BinnedSums
        Binned residuals of each band, with equal numbers of bins over the same field.
    rng : numpy.random.Generator
        Random generator for the errors.
    arcsec : mapping of str to float
        Arcsec per pixel of each band.
    absorbed : mapping of str to int
        Number of coefficients per axis that were fitted to these stars, for example 15 at order 4;
        1 for a model that was not fitted to them.

    Returns
    -------
    dict of str to StatisticsTable
        Tables that have rows; Table 5-2 needs at least two bands.

    Raises
    ------
    DegenerateError
        If too few bins of a band have two stars.
    """
    pixels = {(name, axis): bands[name].values(axis) for name, axis in product(bands, BAND_AXES)}
    scaled = {(name, axis): values.scaled(arcsec[name]) for (name, axis), values in pixels.items()}
    fitting = tuple(
        # the fit does not reduce the scatter of single stars (radial rows)
        bin_row(
            f"{name}/{axis}", values, absorbed=1 if axis == "radial" else absorbed[name], rng=rng
        )
        for (name, axis), values in pixels.items()
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
