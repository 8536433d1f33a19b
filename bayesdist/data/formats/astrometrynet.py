"""Correspondences of astrometry.net (`corr.fits`): detections with their index stars."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from astropy.table import Table

from bayesdist.data.matches import Matches
from bayesdist.data.reading.options import ReadOptions
from bayesdist.data.reading.table import matches_from_table
from bayesdist.data.tables.names import ALIASES

# the other quantities are left out: 'mag', if there is one, is the index star's
COLUMNS = dict.fromkeys(ALIASES, "") | {
    "x": "field_x",
    "y": "field_y",
    "ra": "index_ra",
    "dec": "index_dec",
}


def is_astrometrynet(names: Iterable[str]) -> bool:
    """True for a table with the columns of a `corr.fits`."""
    return {"field_x", "field_y", "index_ra", "index_dec"} <= set(names)


def matches_from_corr(
    table: Table, options: ReadOptions, *, source: str, exposure_name: str | None
) -> Matches:
    """Matches from the columns of a `corr.fits`; missing columns or values are refused.

    field_x and field_y are FITS 1-based pixels; index_ra and index_dec are projected to the tangent
    plane in seconds of arc.  Magnitudes are instrumental, -2.5 log10 FLUX, where all fluxes are
    positive.  There are no errors.  The format fixes columns, origin and unit, so that `options`
    must not.
    """
    columns = COLUMNS | ({"flux": "FLUX"} if "FLUX" in table.colnames else {})
    options = replace(options, columns=columns, unit=None, sigma="by_magnitude")
    return matches_from_table(table, options, source=source, exposure_name=exposure_name)
