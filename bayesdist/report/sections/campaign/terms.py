"""Linear terms of the exposures and their lines in time, and their names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesdist.utils.arrays import Bool, Float

if TYPE_CHECKING:
    from bayesdist.report.campaign import LinearSeries

TERM_ORDER = ("A_2", "B_3", "B_2", "A_3", "B_1", "A_1")  # as in the published report
_FEWEST = 3  # dates in a segment that fix a parabola

_TERMS = {
    "A_1": "A_1 (constant of u)",
    "A_2": "A_2 (X scale)",
    "A_3": "A_3 (angle of the Y axis)",
    "B_1": "B_1 (constant of v)",
    "B_2": "B_2 (residual rotation)",
    "B_3": "B_3 (Y scale)",
}
_SCATTER = {
    "scale": "scale",
    "shear_plus": "shear along the axes (X scale against Y scale)",
    "shear_cross": "shear across the axes (skew)",
    "shift_u": "shift in u",
    "shift_v": "shift in v",
}


def name_of_term(term: str) -> str:
    """Name of a linear term with its meaning, as ACS ISR 2015-06 (Section 4.2) gives it."""
    return _TERMS.get(term, term)


def name_of_scatter(kind: str) -> str:
    """Name of a term in which the exposures scatter; a single chip's name comes first."""
    chip, _, bare = kind.rpartition(".")
    text = _SCATTER.get(bare, bare.replace("_", " "))
    return f"{chip} against the others: {text}" if chip else f"all chips together: {text}"


@dataclass(frozen=True, eq=False)
class TermCourse:
    """Term of one chip: its values in the exposures, and the lines through them."""

    label: str  # with the chip's name, 'WFC1.A_2'
    value: Float  # (E,), free of aberration
    sigma: Float  # (E,), formal
    raw: Float  # (E,), as measured: times VAFACTOR
    line: Float  # (E,), of the exposure's segment at its date
    drift: Float  # (E,), rate times time since the reference date
    alpha: Float  # (S,)
    beta: Float  # (S,)
    epoch0: Float  # (S,)
    good: Bool  # (E,), exposures that are not off

    @property
    def chip(self) -> str:
        """Name of the chip; empty where there is one only."""
        return self.label.rpartition(".")[0]

    @property
    def reference(self) -> float:
        """Round value near all of them."""
        digits = 3 if self.is_constant else 5
        return round(float(self.alpha[0]), digits)

    @property
    def is_constant(self) -> bool:
        """True for a constant term, in the unit of u and v."""
        return self.label.endswith("_1")

    @property
    def rms_raw(self) -> float:
        """Scatter about the lines before VAFACTOR, its mean taken out."""
        return float(np.std((self.raw - self.line)[self.good]))

    @property
    def rms(self) -> float:
        """Scatter about the lines after VAFACTOR."""
        return float(np.std((self.value - self.line)[self.good]))


def terms_of(series: LinearSeries) -> dict[str, tuple[str, ...]]:
    """Labels by term, in the order of the report; chips as the file has them, by name."""
    found: dict[str, list[str]] = {}
    for label in series.labels:
        found.setdefault(label.rpartition(".")[2], []).append(label)
    order = sorted(found, key=lambda t: TERM_ORDER.index(t) if t in TERM_ORDER else 99)
    return {term: tuple(sorted(found[term])) for term in order}


def course_of(series: LinearSeries, lines: Sequence[Mapping[str, Any]], label: str) -> TermCourse:
    """Term of the exposures with its lines, which are `time_dependence.lines` of summary.json."""
    rows = sorted((r for r in lines if r["term"] == label), key=lambda r: int(r["segment"]))
    alpha, beta, epoch0 = (
        np.array([np.nan if r[k] is None else r[k] for r in rows], float)
        for k in ("alpha", "beta", "epoch0")
    )
    s = np.minimum(series.segment, len(rows) - 1)
    value = np.asarray(series.exposures[label], float)
    drift = beta[s] * (series.epoch - epoch0[s])
    return TermCourse(
        label=label,
        value=value,
        sigma=np.asarray(series.exposures[f"sigma_{label}"], float),
        raw=value * series.vafactor,
        line=alpha[s] + drift,
        drift=drift,
        alpha=alpha,
        beta=beta,
        epoch0=epoch0,
        good=~series.outlying,
    )


def line_error(series: LinearSeries, column: str, s: int, t: Float) -> Float | None:
    """Error of a line, or of a new exposure about it, at dates of segment `s`, or None.

    Its square is a parabola through the values of a column of drift.ecsv, which has them at some
    dates; None where too few of these are in the segment.
    """
    epoch = np.asarray(series.drift["epoch"], float)
    here = np.searchsorted(np.asarray(series.breaks, float), epoch, side="right") == s
    if here.sum() < _FEWEST:
        return None
    middle = epoch[here].mean()
    variance = np.asarray(series.drift[column], float)[here] ** 2
    if not np.isfinite(variance).all():
        return None
    unit = variance.max()
    square = unit * np.polyval(np.polyfit(epoch[here] - middle, variance / unit, 2), t - middle)
    return np.sqrt(np.maximum(square, 0.0))
