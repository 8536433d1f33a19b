"""Tables of statistics of binned residuals with errors, in the layout of WSDC D-T033."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from astropy.table import Table

from bayesdist.diagnose.residuals.binned import BAND_AXES, BinnedSums
from bayesdist.diagnose.residuals.rows import STATISTICS, StatisticsRow, bin_row

_HEADS = dict(
    zip(STATISTICS, ("Mean", "Sigma", "Min", "Max", "Median", "1%-tile", "99%-tile"), strict=True)
)


@dataclass(frozen=True, eq=False)
class StatisticsTable:
    """Rows of statistics."""

    title: str
    first: str  # heading of the column of labels
    unit: str  # 'pix' or 'arcsec'
    rows: tuple[StatisticsRow, ...]

    def __getitem__(self, label: str) -> StatisticsRow:
        for row in self.rows:
            if row.label == label:
                return row
        raise KeyError(label)

    def to_table(self, *, errors: bool = False) -> Table:
        """The table in the layout of the report.

        Columns are 'Band/Axis' (or `first`), Mean, Sigma, Min, Max, Median, 1%-tile and 99%-tile;
        with `errors` also 'Mean error', 'Mean noise-free' and so on, 'Sigma noise', 'Bins' and
        'Bins left out'.
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


def period_table(
    periods: Mapping[str, BinnedSums],
    *,
    rng: np.random.Generator,
    arcsec_per_pixel: float,
    absorbed: int | Mapping[str, int] = 1,
) -> StatisticsTable:
    """Table C-1: residuals of one band in several periods, in arcsec.

    `periods` are in the order of the table and include the combined one; all residuals refer to the
    combined model.  `rng` is used for the errors.  `absorbed` is the number of coefficients per
    axis that were fitted to the residuals, or a mapping by period if it differs; 1 if the model was
    not fitted to these stars.  Raises DegenerateError if too few bins of a period contain two
    stars.
    """
    rows = tuple(
        bin_row(
            f"{name}/{axis}",
            bins.values(axis).scaled(arcsec_per_pixel),
            absorbed=absorbed if isinstance(absorbed, int) else absorbed[name],
            rng=rng,
        )
        for axis in BAND_AXES[:2]
        for name, bins in periods.items()
    )
    return StatisticsTable("Residuals by period", "Period/Axis", "arcsec", rows)
