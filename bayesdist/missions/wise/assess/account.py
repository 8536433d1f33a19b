"""Decomposition of the sigma of a residual table, and comparison with the published value.

The variance of the mean residuals in bins is sigma^2 = noise^2 + partition^2 + rest^2: the errors
of single stars, offsets between blocks of the array, and all other structure.  For a published
sigma only the noise can be estimated, from the radial rows and the sample sizes; the remainder is
structure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from bayesdist.diagnose.residuals.tables import StatisticsRow, StatisticsTable
from bayesdist.missions.wise.assess.residual_field import ResidualPartition
from bayesdist.missions.wise.assess.residual_tables import (
    TABLE_5_1,
    TABLE_5_2,
    TABLE_5_3,
    PrintedRow,
    noise_of_bins,
    printed_rows,
)
from bayesdist.missions.wise.published import SAMPLE_SIZES, WISE_ARCSEC

PRINTED_BINS = 31
# longest difference vectors in section 4: between bands, in pixels of W1; and from the optical
# (Code V) model, in pixels of the band
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
    """Contributions to the sigma of one row, and comparison with the published row."""

    row: StatisticsRow
    # rms due to blocks of the array, with their noise subtracted; None if there are none, or blocks
    # do not affect the row
    partition: float | None
    printed: PrintedRow | None = None  # published row
    printed_noise: tuple[float, float] | None = None  # lowest and highest noise in its sigma
    contradictions: tuple[str, ...] = ()  # sentences on inconsistent published numbers

    @property
    def structure(self) -> float:
        """Sigma with the noise subtracted in quadrature."""
        return self.row.noise_free["sigma"]

    @property
    def rest(self) -> float:
        """Structure that the partition does not explain; 0 if it explains all of it."""
        part = 0.0 if self.partition is None else self.partition
        return float(np.sqrt(max(self.structure**2 - part**2, 0.0)))

    @property
    def printed_variance(self) -> tuple[float, float] | None:
        """Published variance minus the highest and the lowest noise variance; may be negative."""
        if self.printed is None or self.printed_noise is None:
            return None
        total = self.printed.value["sigma"] ** 2
        low, high = self.printed_noise
        return float(total - high**2), float(total - low**2)

    @property
    def printed_structure(self) -> float | None:
        """Published sigma without noise, for the mean of the highest and lowest noise variance."""
        v = self.printed_variance
        return None if v is None else float(np.sqrt(max(sum(v) / 2, 0.0)))

    @property
    def remains(self) -> float | None:
        """Difference in quadrature between the published structure and that of this row.

        It is positive if the published structure is larger, and 0 if both agree within the errors.
        """
        v, variance = self.printed_variance, self.row.variance
        if v is None:
            return None
        apart = sum(v) / 2 - variance
        return 0.0 if self.verdict == "same" else float(np.sign(apart) * np.sqrt(abs(apart)))

    @property
    def tolerance(self) -> float:
        """Tolerance for the difference of the variances: two standard errors plus rounding.

        The published variance is assumed to be as uncertain as that of this row.
        """
        digits = 0.0
        if self.printed is not None:
            digits = 2 * self.printed.value["sigma"] * self.printed.rounding["sigma"]
        return float(2 * np.sqrt(2) * self.row.variance_error + digits)

    @property
    def verdict(self) -> str:
        """'same', 'print has more', 'print has less' or 'below noise'; '' if not published."""
        if self.printed_variance is None:
            return ""
        (low, high), variance, slack = self.printed_variance, self.row.variance, self.tolerance
        if low - slack <= variance <= high + slack:
            return "same"
        if high < -slack:
            return "below noise"
        return "print has more" if variance < low else "print has less"

    @property
    def sentence(self) -> str:
        """Explanation of the difference between the two sigmas; empty if none is published."""
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
            return (
                f"{out}, which exceeds the published sigma: its errors have another distribution."
            )
        larger_set = "the published set" if self.verdict == "print has more" else "this set"
        if self.row.label.endswith("/radial"):
            origin = "in the variation over the array of the scatter of single stars"
        elif "-" in self.row.label:
            origin = "because the errors of its two bands are larger or less similar"
        else:
            origin = "from systematic errors that the other does not have"
        return (
            f"{out}; {larger_set} has {abs(self.remains or 0.0):.2g} more in quadrature, {origin}."
        )


def accounts(
    tables: Mapping[str, StatisticsTable],
    parts: Mapping[tuple[str, str], float],
    arcsec: Mapping[str, float],
    n_used: Mapping[str, int],
    *,
    published: bool,
) -> dict[str, tuple[RowAccount, ...]]:
    """Decompose the sigmas of all rows of the residual tables.

    The noise in a published sigma follows from the published mean length of single residuals and
    their distribution.  The distribution is not published.  The limits of the noise are those for
    a normal distribution and for the distribution in these data.

    Parameters
    ----------
    tables : mapping of str to StatisticsTable
        Tables '5-1', '5-2' and '5-3'.
    parts : mapping of (str, str) to float
        Rms of the partition by table and label, from `partition_parts`.
    arcsec : mapping of str to float
        Arcsec per pixel of each band.
    n_used : mapping of str to int
        Number of pairs of each band in the bins.
    published : bool
        True if the bands and the number of bins are those of WSDC D-T033.

    Returns
    -------
    dict of str to tuple of RowAccount
        Rows by table.
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
        # labels occur in Tables 5-1 and 5-3 (one band) or only in 5-2 (two bands); contradictions
        # belong to Tables 5-2 and 5-3
        row_contradictions = [s for s in across if table != "5-1" and s.startswith(f"{label}:")]
        return replace(
            one,
            printed=printed,
            printed_noise=_noises(label, table, tables["5-1"], n_used, rows["5-1"], arcsec),
            contradictions=(*contradictions_within(printed), *row_contradictions),
        )

    return {name: tuple(with_printed(name, one) for one in out[name]) for name in out}


def partition_parts(
    partitions: Mapping[str, ResidualPartition], arcsec: Mapping[str, float]
) -> dict[tuple[str, str], float]:
    """Rms contribution of significant partitions to the sigma of each row.

    Parameters
    ----------
    partitions : mapping of str to ResidualPartition
        Partitions by band, of residuals in pixels; those that are not significant are ignored.
    arcsec : mapping of str to float
        Arcsec per pixel of each band.

    Returns
    -------
    dict of (str, str) to float
        By table and label, the rms over the array without the noise of the fitted blocks, in the
        unit of the table.
    """
    significant = {name: p for name, p in partitions.items() if p.significant}
    out: dict[tuple[str, str], float] = {}
    names = list(partitions)
    for k, axis in enumerate("XY"):
        for name, p in significant.items():
            out["5-1", f"{name}/{axis}"] = p.rms[k]
            out["5-3", f"{name}/{axis}"] = float(np.sqrt(2)) * arcsec[name] * p.rms[k]
        for i, earlier in enumerate(names):
            for later in names[i + 1 :]:
                pair = {name: significant[name] for name in (earlier, later) if name in significant}
                if pair:
                    out["5-2", f"{later}-{earlier}/{axis}"] = _difference(pair, arcsec, earlier, k)
    return out


def _difference(
    found: Mapping[str, ResidualPartition], arcsec: Mapping[str, float], minus: str, axis: int
) -> float:
    """Rms of the difference of two patterns, without their noise."""
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
    """Lowest and highest noise of a published row, for the number of bands in its label."""
    bands, _, axis = label.partition("/")
    square = np.zeros(2)
    for band in bands.split("-"):
        length, printed = (
            noise_of_bins(r[f"{band}/radial"].value["mean"], n[band], PRINTED_BINS**2)
            for r, n in ((fitting, n_used), (printed_fitting, SAMPLE_SIZES))
        )
        # the scatter of the lengths of normal residuals is smaller than that of the residuals
        normal = float(np.sqrt(2 - np.pi / 2)) if axis == "radial" else 1.0
        ratio = fitting[f"{band}/{axis}"].sigma_noise / length
        scale = 1.0 if table == "5-1" else arcsec[band]
        square += (scale * printed * np.sort([normal, ratio])) ** 2
    low, high = np.sqrt(2 * square if table == "5-3" else square)
    return float(low), float(high)


# -- contradictions between published numbers -----------------------------------------------------


def contradictions_within(row: PrintedRow) -> list[str]:
    """Sentences on statistics of a row that are impossible for any sample.

    The checks are the order of extremes, percentiles and median; a mean at most one sigma from the
    median; and sigma^2 <= (max - mean) (mean - min) (Bhatia and Davis).  Differences that rounding
    can explain are ignored.
    """
    v, h = row.value, row.rounding
    out = []
    for a, b in pairwise(("min", "p01", "median", "p99", "max")):
        if v[a] - v[b] > h[a] + h[b]:
            out.append(f"{row.label}: {a} {v[a]:g} is above {b} {v[b]:g}.")
    apart = abs(v["mean"] - v["median"])
    if apart > v["sigma"] + h["mean"] + h["median"] + h["sigma"]:
        out.append(
            f"{row.label}: mean {v['mean']:g} and median {v['median']:g} are {apart:.4g} apart, "
            f"more than sigma {v['sigma']:g}, which no set of numbers allows."
        )
    above = max(v["max"] - v["mean"] + h["max"] + h["mean"], 0.0)
    below = max(v["mean"] - v["min"] + h["mean"] + h["min"], 0.0)
    if v["sigma"] - h["sigma"] > np.sqrt(above * below):
        out.append(
            f"{row.label}: sigma {v['sigma']:g} is more than the extremes allow "
            f"({np.sqrt(above * below):.4g})."
        )
    return out


def contradictions_across(
    fitting: Mapping[str, PrintedRow],
    band_to_band: Mapping[str, PrintedRow],
    multiframe: Mapping[str, PrintedRow],
) -> list[str]:
    """Sentences on numbers of Tables 5-2 and 5-3 that do not follow from Table 5-1.

    The differences of all pairs of bins in one band have sqrt(2) times the sigma, and the range as
    maximum.  For two bands the mean is the difference of their means, and sigma is limited by their
    sigmas.  Within Table 5-2 the mean difference of two bands must equal the sum of those through a
    third band.

    Parameters
    ----------
    fitting, band_to_band, multiframe : mapping of str to PrintedRow
        Tables 5-1 (pixels), 5-2 and 5-3 (arcsec).

    Returns
    -------
    list of str
        One sentence per contradiction that rounding cannot explain, with the implied value.
    """
    out = []
    for label, row in multiframe.items():
        printed, scale = fitting[label], WISE_ARCSEC[label.partition("/")[0]]
        sigma = np.sqrt(2) * scale * printed.value["sigma"]
        slack = np.sqrt(2) * scale * printed.rounding["sigma"]
        out += _unequal(row, "sigma", float(sigma), float(slack))
        extent = scale * (printed.value["max"] - printed.value["min"])
        out += _unequal(
            row, "max", extent, scale * (printed.rounding["max"] + printed.rounding["min"])
        )
    for label, row in band_to_band.items():
        bands, _, axis = label.partition("/")
        scaled = [(WISE_ARCSEC[name], fitting[f"{name}/{axis}"]) for name in bands.split("-")]
        (a, first), (b, second) = scaled
        mean = a * first.value["mean"] - b * second.value["mean"]
        slack = a * first.rounding["mean"] + b * second.rounding["mean"]
        out += _unequal(row, "mean", mean, slack)
        low, high = _sigma_limits(a, first, b, second)
        if not low - row.rounding["sigma"] <= row.value["sigma"] <= high + row.rounding["sigma"]:
            out.append(
                f"{label}: sigma {row.value['sigma']:g} is outside {low:.4g} to {high:.4g}, which "
                "the sigmas of the two bands allow."
            )
    return out + _open_triangles(band_to_band)


def _open_triangles(band_to_band: Mapping[str, PrintedRow]) -> list[str]:
    """Mean differences of two bands that are not confirmed through any third band.

    A wrong value affects all triangles that contain it, but only one of the triangles of any other
    difference.
    """
    sides: dict[tuple[str, str, str], tuple[float, float]] = {}
    for label, row in band_to_band.items():
        bands, _, axis = label.partition("/")
        a, b = bands.split("-")
        sides[a, b, axis] = row.value["mean"], row.rounding["mean"]
        sides[b, a, axis] = -row.value["mean"], row.rounding["mean"]
    names = sorted({a for a, _, _ in sides})
    out = []
    for label, row in band_to_band.items():
        bands, _, axis = label.partition("/")
        a, b = bands.split("-")
        detours = [
            (sides[a, c, axis], sides[c, b, axis], c)
            for c in names
            if (a, c, axis) in sides and (c, b, axis) in sides
        ]
        sentences_by_band = [
            (_unequal(row, "mean", step_1 + step_2, h + k), c)
            for (step_1, h), (step_2, k), c in detours
        ]
        if len(sentences_by_band) > 1 and all(sentences for sentences, _ in sentences_by_band):
            through = ", ".join(c for _, c in sentences_by_band)
            out.append(
                sentences_by_band[0][0][0].replace(" follows.", f" follows by way of {through}.")
            )
    return out


def _unequal(row: PrintedRow, name: str, implied: float, slack: float) -> list[str]:
    if abs(row.value[name] - implied) <= slack + row.rounding[name]:
        return []
    return [f"{row.label}: {name} {row.value[name]:g} is published, {implied:.4g} follows."]


def _sigma_limits(a: float, first: PrintedRow, b: float, second: PrintedRow) -> tuple[float, float]:
    """Limits of the sigma of a difference, for correlations 1 and -1."""
    sigma_a, sigma_b = a * first.value["sigma"], b * second.value["sigma"]
    slack = a * first.rounding["sigma"] + b * second.rounding["sigma"]
    return max(abs(sigma_a - sigma_b) - slack, 0.0), sigma_a + sigma_b + slack
