"""Tables 5-1, 5-2, 5-3 and C-1 of WSDC D-T033, each statistic with its error."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from astropy.table import Table

from bayesdist.diagnose.residuals.binned import BAND_AXES, BinnedSums, BinValues
from bayesdist.diagnose.residuals.rows import (
    STATISTICS,
    StatisticsRow,
    bin_row,
    pair_row,
)

__all__ = [
    "WISE_ARCSEC",
    "StatisticsTable",
    "band_to_band_table",
    "fitting_table",
    "multiframe_table",
    "period_table",
]

_HEADS = dict(
    zip(STATISTICS, ("Mean", "Sigma", "Min", "Max", "Median", "1%-tile", "99%-tile"), strict=True)
)
_AXES = BAND_AXES[:2]
WISE_ARCSEC = {"W1": 2.75, "W2": 2.75, "W3": 2.75, "W4": 5.5}  # per pixel; W4 is binned 2 x 2


@dataclass(frozen=True, eq=False)
class StatisticsTable:
    """Rows of statistics."""

    title: str
    first: str  # head of the column of labels
    unit: str  # 'pix' or 'arcsec'
    rows: tuple[StatisticsRow, ...]

    def __getitem__(self, label: str) -> StatisticsRow:
        for row in self.rows:
            if row.label == label:
                return row
        raise KeyError(label)

    def to_table(self, *, errors: bool = False) -> Table:
        """The table in the report's layout.

        Columns are 'Band/Axis' (or as `first`), Mean, Sigma, Min, Max, Median, 1%-tile and
        99%-tile; with `errors` also 'Mean error', 'Mean noise-free' and so on, 'Sigma noise',
        'Bins' and 'Bins left out'.
        """
        out = Table(meta={"title": self.title, "unit": self.unit})
        out[self.first] = [row.label for row in self.rows]
        parts = [("", "value")]
        if errors:
            parts += [(" error", "error"), (" noise-free", "noise_free")]
        for name, head in _HEADS.items():
            for suffix, part in parts:
                out[head + suffix] = np.array([getattr(row, part)[name] for row in self.rows])
                out[head + suffix].unit = self.unit
                out[head + suffix].format = ".4g"
        if errors:
            out["Sigma noise"] = np.array([row.sigma_noise for row in self.rows])
            out["Sigma noise"].unit = self.unit
            out["Sigma noise"].format = ".4g"
            out["Bins"] = [row.n_bins for row in self.rows]
            out["Bins left out"] = [row.n_left_out for row in self.rows]
        return out


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


def period_table(
    periods: Mapping[str, BinnedSums],
    *,
    rng: np.random.Generator,
    arcsec_per_pixel: float,
    absorbed: int | Mapping[str, int] = 1,
) -> StatisticsTable:
    """Table C-1: residuals of one band in several periods, in arcsec.

    Periods are in the order of the table, the combined one among them, all against the combined
    model; `absorbed` is by the name of the period where it differs. Others as of `fitting_table`.
    """
    rows = tuple(
        bin_row(
            f"{name}/{axis}",
            bins.values(axis).scaled(arcsec_per_pixel),
            absorbed=absorbed if isinstance(absorbed, int) else absorbed[name],
            rng=rng,
        )
        for axis in _AXES
        for name, bins in periods.items()
    )
    return StatisticsTable("Residuals by period", "Period/Axis", "arcsec", rows)


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
