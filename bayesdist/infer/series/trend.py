"""Trends of a coefficient with time: constant, lines, steps, kinks, smooth or irregular drift.

A trend is linear in its parameters once the dates of its breaks are known; its columns are the
same for every coefficient of a series.  R is the reference date of a segment, as RDATE in Equation
3 of ACS ISR 2015-06.

    constant    a
    line        a + b (t - R)
    step        a_s in segment s
    line+step   a_s + b (t - R_s)
    piecewise   continuous, of slope b_s in segment s
    lines       a_s + b_s (t - R_s)
    spline      a line, and a smooth deviation: a Wiener process integrated once, seen at few knots
    random_walk      a constant, and an irregular deviation: a Wiener process, seen at many knots
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.errors import InputError

MIN_EXPOSURES_FOUND = 5  # of a segment at least, where the breaks are to be found


@dataclass(frozen=True)
class Form:
    """Parameters of one kind of trend."""

    levels: bool = False  # a level in each segment; else one for all
    slopes: str = "none"  # 'one', 'each' segment its own, or 'kinks' between them
    knots: int = 0  # of the random part, if any
    smooth: bool = False  # of that part
    least: int = 1  # exposures of a segment, where the breaks are given

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
    """One form of dependence on time.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    breaks : tuple of float
        Dates at which a new segment begins, ascending, decimal years.
    find : int
        Number of breaks to be found, where none are given.
    reference : tuple of float
        Reference date of each segment; one date serves all.  By default the mean date of the
        segment's exposures, or of all where the breaks are to be found.
    groups : str
        'offsets': each group but the first has its own offset; 'slopes': and its own slope.

    Raises
    ------
    InputError
        For an unknown kind, breaks that do not ascend, or breaks where the kind has none or needs
        some, and a wrong number of reference dates.
    """

    kind: str
    breaks: tuple[float, ...] = ()
    find: int = 0
    reference: tuple[float, ...] = ()
    groups: str = "offsets"

    def __post_init__(self) -> None:
        where = f"trend {self.kind!r}"
        if self.kind not in KINDS:
            raise InputError("unknown trend", where=where, do=f"choose among {', '.join(KINDS)}")
        if self.groups not in ("offsets", "slopes"):
            raise InputError(
                f"groups is {self.groups!r}", where=where, do="choose offsets or slopes"
            )
        if not np.isfinite((*self.breaks, *self.reference)).all():
            raise InputError("a date is not finite", where=where, do="give decimal years")
        if list(self.breaks) != sorted(set(self.breaks)):
            raise InputError(
                f"breaks {list(self.breaks)} do not rise",
                where=where,
                do="sort them and name each once",
            )
        if not self.form.broken and (self.breaks or self.find):
            broken = [kind for kind, form in FORMS.items() if form.broken]
            raise InputError("has no breaks", where=where, do=f"choose among {', '.join(broken)}")
        if self.form.broken and bool(self.breaks) == bool(self.find):
            raise InputError(
                "needs the dates of its breaks, or how many are to be found",
                where=where,
                do="give one of breaks and find",
            )
        if self.find < 0:
            raise InputError(f"find is {self.find}", where=where, do="give 1 or more")
        if len(self.reference) not in (0, 1, self.n_segments):
            raise InputError(
                f"{len(self.reference)} reference dates for {self.n_segments} segments",
                where=where,
                do="give one date, or one for each segment",
            )

    @property
    def form(self) -> Form:
        """What parameters it has."""
        return FORMS[self.kind]

    @property
    def n_breaks(self) -> int:
        """Number of breaks, given or to be found."""
        return self.find or len(self.breaks)

    @property
    def n_segments(self) -> int:
        """Number of segments: one more than the breaks."""
        return self.n_breaks + 1

    @property
    def n_columns(self) -> int:
        """Number of columns, without groups and random part."""
        s = self.n_segments
        return self.n_levels + {"none": 0, "one": 1, "each": s, "kinks": s}[self.form.slopes]

    @property
    def n_levels(self) -> int:
        """Number of levels, the first of the columns."""
        return self.n_segments if self.form.levels else 1

    @property
    def name(self) -> str:
        """Kind, with the breaks: 'lines, break at 2009.4'."""
        if self.breaks:
            dates = ", ".join(f"{b:g}" for b in self.breaks)
            return f"{self.kind}, break{'s' * (len(self.breaks) > 1)} at {dates}"
        if self.find:
            return f"{self.kind}, {self.find} break{'s' * (self.find > 1)} found"
        return self.kind

    @property
    def drifts(self) -> bool:
        """True if it has a random part that can follow any drift."""
        return self.form.knots > 0

    @property
    def has_slope(self) -> bool:
        """True if it claims a drift that goes on."""
        return self.form.slopes != "none"
