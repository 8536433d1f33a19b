"""Trends of coefficients with time: constant, lines, steps, kinks, smooth or irregular drift.

For given break dates a trend is linear in its parameters, with the same design matrix for all
coefficients of a series.  R is the reference date of a segment, like RDATE in Equation 3 of ACS ISR
2015-06.

    constant     a
    line         a + b (t - R)
    step         a_s in segment s
    line+step    a_s + b (t - R_s)
    piecewise    continuous, with slope b_s in segment s
    lines        a_s + b_s (t - R_s)
    spline       a line plus a smooth deviation: an integrated Wiener process with few knots
    random_walk  a constant plus an irregular deviation: a Wiener process with many knots
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.errors import InputError

MIN_EXPOSURES_FOUND = 5  # minimum number of exposures per segment if breaks are unknown


@dataclass(frozen=True)
class Form:
    """Parameters of a kind of trend."""

    levels: bool = False  # True for a level per segment, False for a common level
    # 'none'; 'one' for a common slope; 'each' for a slope per segment; 'kinks' if also continuous
    slopes: str = "none"
    knots: int = 0  # number of knots of the random part; 0 for none
    smooth: bool = False  # True if the random part is smooth
    least: int = 1  # minimum number of exposures per segment for given breaks

    @property
    def broken(self) -> bool:
        """True if segments differ."""
        return self.levels or self.slopes == "kinks"


FORMS = {
    "constant": Form(),
    "line": Form(slopes="one"),
    "step": Form(levels=True),
    "line+step": Form(levels=True, slopes="one"),
    "piecewise": Form(slopes="kinks", least=2),
    "lines": Form(levels=True, slopes="each", least=3),
    "spline": Form(slopes="one", knots=8, smooth=True),
    "random_walk": Form(knots=16),
}
KINDS = tuple(FORMS)


@dataclass(frozen=True)
class TrendModel:
    """Model of the dependence of coefficients on time.

    Parameters
    ----------
    kind : str
        One of `KINDS`: 'constant', 'line', 'step', 'line+step', 'piecewise', 'lines', 'spline' or
        'random_walk'.
    breaks : tuple of float
        Dates at which a new segment begins, ascending, in decimal years.
    find : int
        Number of breaks at unknown dates, if `breaks` is empty.
    reference : tuple of float
        Reference date of each segment, or a common one, in decimal years. By default the mean date
        of the exposures in the segment or, for unknown breaks, of all exposures.
    groups : str
        'offsets' if groups of exposures (filters) differ by offsets, 'slopes' if they also differ
        in slope.

    Raises
    ------
    InputError
        If the kind is unknown, breaks are not ascending, breaks are given for a kind without
        breaks, or missing for a kind that needs them, or the number of reference dates is wrong.
    """

    kind: str
    breaks: tuple[float, ...] = ()
    find: int = 0
    reference: tuple[float, ...] = ()
    groups: str = "offsets"

    def __post_init__(self) -> None:
        label = f"trend {self.kind!r}"
        if self.kind not in KINDS:
            raise InputError("unknown trend", where=label, do=f"choose among {', '.join(KINDS)}")
        if self.groups not in ("offsets", "slopes"):
            raise InputError(
                f"groups is {self.groups!r}", where=label, do="choose offsets or slopes"
            )
        if not np.isfinite((*self.breaks, *self.reference)).all():
            raise InputError("a date is not finite", where=label, do="give decimal years")
        if list(self.breaks) != sorted(set(self.breaks)):
            raise InputError(
                f"breaks {list(self.breaks)} are not ascending",
                where=label,
                do="sort them and name each once",
            )
        if not self.form.broken and (self.breaks or self.find):
            broken = [kind for kind, form in FORMS.items() if form.broken]
            raise InputError("has no breaks", where=label, do=f"choose among {', '.join(broken)}")
        if self.form.broken and bool(self.breaks) == bool(self.find):
            raise InputError(
                "needs the dates of its breaks, or the number of breaks to find",
                where=label,
                do="give one of breaks and find",
            )
        if self.find < 0:
            raise InputError(f"find is {self.find}", where=label, do="give 1 or more")
        if len(self.reference) not in (0, 1, self.n_segments):
            raise InputError(
                f"{len(self.reference)} reference dates for {self.n_segments} segments",
                where=label,
                do="give one date, or one per segment",
            )

    @property
    def form(self) -> Form:
        """Parameters of this kind of trend."""
        return FORMS[self.kind]

    @property
    def n_breaks(self) -> int:
        """Number of breaks, given or unknown."""
        return self.find or len(self.breaks)

    @property
    def n_segments(self) -> int:
        """Number of segments: number of breaks plus one."""
        return self.n_breaks + 1

    @property
    def n_columns(self) -> int:
        """Number of columns of the design matrix, without groups and random part."""
        s = self.n_segments
        return self.n_levels + {"none": 0, "one": 1, "each": s, "kinks": s}[self.form.slopes]

    @property
    def n_levels(self) -> int:
        """Number of levels, which are the first columns of the design matrix."""
        return self.n_segments if self.form.levels else 1

    @property
    def name(self) -> str:
        """Kind and breaks as text, such as 'lines, break at 2009.4'."""
        if self.breaks:
            dates = ", ".join(f"{b:g}" for b in self.breaks)
            return f"{self.kind}, break{'s' * (len(self.breaks) > 1)} at {dates}"
        if self.find:
            return f"{self.kind}, {self.find} break{'s' * (self.find > 1)} found"
        return self.kind

    @property
    def drifts(self) -> bool:
        """True if the trend has a random part, which can follow any drift."""
        return self.form.knots > 0

    @property
    def has_slope(self) -> bool:
        """True if the trend has slopes, that is, a drift that can be extrapolated."""
        return self.form.slopes != "none"
