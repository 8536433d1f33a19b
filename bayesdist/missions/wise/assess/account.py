"""Parts of the sigma of a residual table, and why it is not the printed one.

sigma^2 of means of bins is noise^2 + partition^2 + rest^2: the errors of single stars, blocks of
the array that stand apart, and what is left.  Of a printed sigma the noise alone can be told, from
the radial rows and the sample sizes; the remainder is structure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from bayesdist.diagnose.residuals.rows import StatisticsRow
from bayesdist.diagnose.residuals.tables import StatisticsTable
from bayesdist.missions.wise.assess.contradictions import (
    contradictions_across,
    contradictions_within,
)
from bayesdist.missions.wise.assess.published import (
    TABLE_5_1,
    TABLE_5_2,
    TABLE_5_3,
    PrintedRow,
    noise_of_bins,
    printed_rows,
)
from bayesdist.missions.wise.assess.residual_structure import ResidualPartition
from bayesdist.missions.wise.published import SAMPLE_SIZES

PRINTED_BINS = 31
# section 4: longest difference vectors, in pixels of W1, and from the Code V model, in the band's
LONGEST_DIFFERENCES = {
    ("W2", "W1"): 0.398,
    ("W3", "W1"): 0.876,
    ("W4", "W1"): 0.940,
    ("W1", "optical"): 1.640,
    ("W2", "optical"): 1.658,
    ("W3", "optical"): 1.605,
    ("W4", "optical"): 0.976,
}
PRINTED_TABLES = {"5-1": TABLE_5_1, "5-2": TABLE_5_2, "5-3": TABLE_5_3}


@dataclass(frozen=True)
class RowAccount:
    """The parts of one row's sigma, and the printed row beside it."""

    row: StatisticsRow
    # rms that blocks of the array add, their noise subtracted; None where none were found, or the
    # row is not of what blocks act on
    partition: float | None
    printed: PrintedRow | None = None
    # least and most noise that the printed sigma holds
    printed_noise: tuple[float, float] | None = None
    # what the printed numbers contradict in themselves or in each other
    contradictions: tuple[str, ...] = ()

    @property
    def structure(self) -> float:
        """Sigma without noise."""
        return self.row.noise_free["sigma"]

    @property
    def rest(self) -> float:
        """Structure beside the partition; 0 where that explains all."""
        part = 0.0 if self.partition is None else self.partition
        return float(np.sqrt(max(self.structure**2 - part**2, 0.0)))

    @property
    def printed_variance(self) -> tuple[float, float] | None:
        """Square of the printed sigma less the most and the least noise; may be below zero."""
        if self.printed is None or self.printed_noise is None:
            return None
        total = self.printed.value["sigma"] ** 2
        low, high = self.printed_noise
        return float(total - high**2), float(total - low**2)

    @property
    def printed_structure(self) -> float | None:
        """Printed sigma without its noise, in the middle of what that may be."""
        v = self.printed_variance
        return None if v is None else float(np.sqrt(max(sum(v) / 2, 0.0)))

    @property
    def remains(self) -> float | None:
        """Structure that one has and the other has not, in quadrature.

        Positive where the printed one has more; 0 where they may be the same.
        """
        v, here = self.printed_variance, self.row.variance
        if v is None:
            return None
        apart = sum(v) / 2 - here
        return 0.0 if self.verdict == "same" else float(np.sign(apart) * np.sqrt(abs(apart)))

    @property
    def tolerance(self) -> float:
        """Two standard errors of the difference of two variances, and the digits printed.

        The printed variance counts as uncertain as ours.
        """
        digits = 0.0
        if self.printed is not None:
            digits = 2 * self.printed.value["sigma"] * self.printed.rounding["sigma"]
        return float(2 * np.sqrt(2) * self.row.variance_error + digits)

    @property
    def verdict(self) -> str:
        """'same', 'print has more', 'print has less' or 'below noise'; empty without a print."""
        if self.printed_variance is None:
            return ""
        (low, high), here, slack = self.printed_variance, self.row.variance, self.tolerance
        if low - slack <= here <= high + slack:
            return "same"
        if high < -slack:
            return "below noise"
        return "print has more" if here < low else "print has less"

    @property
    def sentence(self) -> str:
        """Why the printed sigma is not ours; empty without one."""
        if self.printed is None or self.printed_noise is None:
            return ""
        ours, theirs = self.row.value["sigma"], self.printed.value["sigma"]
        noise = " to ".join(dict.fromkeys(f"{end:.2g}" for end in self.printed_noise))
        out = f"{ours:.4g} found, {theirs:.4g} published: "
        out += f"noise is {self.row.sigma_noise:.2g} here and {noise} there"
        if self.partition is not None:
            out += f", the partition {self.partition:.2g} here"
        if self.verdict == "same":
            return f"{out}; structure is the same within its error."
        if self.verdict == "below noise":
            return f"{out}, more than was published: its errors are distributed otherwise."
        whose = "the published set" if self.verdict == "print has more" else "this set"
        if self.row.label.endswith("/radial"):
            what = "in the scatter of single stars over the array"
        elif "-" in self.row.label:
            what = "as the errors of its two bands are larger or less alike"
        else:
            what = "from systematic errors that the other has not"
        return f"{out}; {whose} has {abs(self.remains or 0.0):.2g} more in quadrature, {what}."


def accounts(
    tables: Mapping[str, StatisticsTable],
    parts: Mapping[tuple[str, str], float],
    arcsec: Mapping[str, float],
    n_used: Mapping[str, int],
    *,
    published: bool,
) -> dict[str, tuple[RowAccount, ...]]:
    """Accounts of all rows.

    How much noise a printed sigma holds follows from the printed mean length of single residuals
    and their distribution.  That is not printed: it may be normal, or as it is here.

    `tables`: by '5-1', '5-2' and '5-3'. `parts`: rms of the partition by table and label, as of
    `partition_parts`. `arcsec`: arcsec per pixel of each band. `n_used`: pairs of each band in the
    bins. `published`: True if the bands are those of WSDC D-T033 in as many bins.
    """
    out = {
        name: tuple(RowAccount(row, parts.get((name, row.label))) for row in table.rows)
        for name, table in tables.items()
    }
    if not published:
        return out
    rows = {name: printed_rows(text) for name, text in PRINTED_TABLES.items()}
    across = contradictions_across(rows["5-1"], rows["5-2"], rows["5-3"])

    def with_printed(table: str, one: RowAccount) -> RowAccount:
        label = one.row.label
        printed = rows[table][label]
        # a label with two bands is of Table 5-2, one that 5-3 shares with 5-1 is meant for 5-3
        others = [s for s in across if table != "5-1" and s.startswith(f"{label}:")]
        return replace(
            one,
            printed=printed,
            printed_noise=_noises(label, table, tables["5-1"], n_used, rows["5-1"], arcsec),
            contradictions=(*contradictions_within(printed), *others),
        )

    return {name: tuple(with_printed(name, one) for one in out[name]) for name in out}


def partition_parts(
    partitions: Mapping[str, ResidualPartition], arcsec: Mapping[str, float]
) -> dict[tuple[str, str], float]:
    """Rms that significant partitions add to the sigma of each row.

    `partitions`: by band, of residuals in pixels; bands without one that is significant count as
    having none. The result is by table and label: rms over the array without the noise of the
    fitted blocks, in the unit of the table.
    """
    found = {name: p for name, p in partitions.items() if p.significant}
    out: dict[tuple[str, str], float] = {}
    names = list(partitions)
    for k, axis in enumerate("XY"):
        for name, p in found.items():
            out["5-1", f"{name}/{axis}"] = p.rms[k]
            out["5-3", f"{name}/{axis}"] = float(np.sqrt(2)) * arcsec[name] * p.rms[k]
        for i, earlier in enumerate(names):
            for later in names[i + 1 :]:
                here = {name: found[name] for name in (earlier, later) if name in found}
                if here:
                    out["5-2", f"{later}-{earlier}/{axis}"] = _difference(here, arcsec, earlier, k)
    return out


def _difference(
    found: Mapping[str, ResidualPartition], arcsec: Mapping[str, float], minus: str, axis: int
) -> float:
    """Rms of the difference of two patterns, which may be alike, without their noise."""
    scaled = [
        (-1 if name == minus else 1) * arcsec[name] * p.pattern[axis] for name, p in found.items()
    ]
    total = float(np.nanvar(np.sum(scaled, axis=0)))
    noise = sum(
        arcsec[name] ** 2 * (float(np.nanmean(p.pattern[axis] ** 2)) - p.rms[axis] ** 2)
        for name, p in found.items()
    )
    return float(np.sqrt(max(total - noise, 0.0)))


def _noises(
    label: str,
    table: str,
    fitting: StatisticsTable,
    n_used: Mapping[str, int],
    printed_fitting: Mapping[str, PrintedRow],
    arcsec: Mapping[str, float],
) -> tuple[float, float]:
    """Least and most noise of a printed row; of two bands that of both together."""
    bands, _, axis = label.partition("/")
    square = np.zeros(2)
    for band in bands.split("-"):
        length, printed = (
            noise_of_bins(r[f"{band}/radial"].value["mean"], n[band], PRINTED_BINS**2)
            for r, n in ((fitting, n_used), (printed_fitting, SAMPLE_SIZES))
        )
        # lengths of normal residuals scatter less than the residuals themselves
        normal = float(np.sqrt(2 - np.pi / 2)) if axis == "radial" else 1.0
        here = fitting[f"{band}/{axis}"].sigma_noise / length
        scale = 1.0 if table == "5-1" else arcsec[band]
        square += (scale * printed * np.sort([normal, here])) ** 2
    low, high = np.sqrt(2 * square if table == "5-3" else square)
    return float(low), float(high)
