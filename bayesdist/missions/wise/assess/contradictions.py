"""Contradictions between the published numbers of residual tables.

Statistics of any sample satisfy certain inequalities, and statistics of differences follow from
those of the samples.  Violations reveal misprints, and tables that were made with other models.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from bayesdist.missions.wise.assess.published import PrintedRow
from bayesdist.missions.wise.published import WISE_ARCSEC


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
