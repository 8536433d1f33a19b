"""Models of the dependence of coefficients on time, and their design matrices.

For given break dates a trend is linear in its parameters, with the same design matrix for all
coefficients of a series.  R is the reference date of a segment, as in Equation 3 of
Kozhurina-Platais et al. (2015).

    constant     a
    line         a + b (t - R)
    step         a_s in segment s
    line+step    a_s + b (t - R_s)
    piecewise    continuous, with slope b_s in segment s
    lines        a_s + b_s (t - R_s)
    spline       a line plus a smooth deviation: an integrated Wiener process with few knots
    random_walk  a constant plus an irregular deviation: a Wiener process with many knots

An irregular drift is a Wiener process, a smooth drift an integrated Wiener process; the latter is
the smoothing spline of Wahba (1978).  Both are represented by their values at knots, between which
the conditional mean is linear or cubic.  Since the level (and, for a smooth drift, the slope) is a
free parameter in addition, the date at which the process starts does not matter; here it is the
middle of the series.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import DegenerateError, InputError
from bayesdist.kinds.campaign.series.series import MIN_EXPOSURES_FOUND, Series
from bayesdist.utils.arrays import Float, Int


@dataclass(frozen=True)
class Form:
    """Levels, slopes and random part of a kind of trend."""

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


# -- design matrix of a trend for a series, and the meaning of its parameters ----------------------


@dataclass(frozen=True, eq=False)
class Drift:
    """Random process of unit amplitude, with a variance of about one at the ends of the series."""

    origin: float  # date of the middle of the series
    years: float  # half the span of the series
    knots: Float  # positions (Q,) in units of half the span from the middle, all non-zero
    smooth: bool  # True for the integrated Wiener process

    @classmethod
    def over(cls, epoch: Float, n_knots: int, *, smooth: bool) -> Drift:
        """Make a process with at most `n_knots` knots for a series with these epochs (E,).

        A smooth process has equidistant knots; those of an irregular one follow the exposures.
        """
        first, last = epoch.min(), epoch.max()
        origin, years = (first + last) / 2, (last - first) / 2
        if smooth:
            places = np.linspace(-1, 1, n_knots)
        else:
            places = np.quantile((np.unique(epoch) - origin) / years, np.linspace(0, 1, n_knots))
        places = np.unique(np.round(places, 9))
        return cls(float(origin), float(years), places[np.abs(places) > 1e-6], smooth)

    @property
    def n_columns(self) -> int:
        """Number of knots."""
        return len(self.knots)

    def kernel(self, a: Float, b: Float) -> Float:
        """Covariance (n, m) of the process between dates (n,) and (m,), in half spans."""
        same_side = np.sign(a)[:, None] == np.sign(b)
        x, y = np.abs(a)[:, None], np.abs(b)
        low, high = np.minimum(x, y), np.maximum(x, y)
        values = 3 * low**2 * (high - low / 3) / 2 if self.smooth else low
        return np.where(same_side, values, 0.0)

    def columns(self, epoch: ArrayLike) -> Float:
        """Columns (E, Q) of the design matrix for parameters with independent, equal variances.

        The sum of the columns times such parameters is the conditional mean of the process, given
        its values at the knots.
        """
        places = (np.asarray(epoch, float) - self.origin) / self.years
        factor = np.linalg.cholesky(self.kernel(self.knots, self.knots))
        return np.linalg.solve(factor, self.kernel(self.knots, places)).T


@dataclass(frozen=True, eq=False)
class Design:
    """Design matrix of a trend for a series.

    Parameters
    ----------
    trend : TrendModel
    series : Series

    Raises
    ------
    DegenerateError
        If a segment or a group has too few exposures for the parameters of the trend, or exposures
        of a single date.
    """

    trend: TrendModel
    series: Series

    def __post_init__(self) -> None:
        self._check_segments()
        if self.trend.groups == "slopes":
            for name in self.series.group_names:
                epoch = self.series.epoch[np.array(self.series.group) == name]
                if len(epoch) < 3 or np.ptp(epoch) == 0:
                    raise DegenerateError(
                        f"{len(epoch)} exposures of group {name!r} do not determine its slope",
                        where=self.series.source,
                        do="leave the group out, or use common slopes for all groups",
                    )

        if not self.trend.find and self.n_groups > 1:
            columns = self.matrix(self.series.epoch, self.series.group_code)[0, :, : self.n_fixed]
            if np.linalg.matrix_rank(columns) < self.n_fixed:
                raise DegenerateError(
                    f"the groups ({', '.join(self.series.group_names)}) cannot be distinguished "
                    f"from the trend {self.trend.name!r}: some of them have exposures in one "
                    "segment only",
                    where=self.series.source,
                    do="leave groups out, or remove a break",
                )

    def _check_segments(self) -> None:
        trend, series = self.trend, self.series
        if np.ptp(series.epoch) == 0 and trend.kind != "constant":
            raise DegenerateError(
                "all exposures have the same date", where=series.source, do="choose a constant"
            )
        if trend.find:
            need = MIN_EXPOSURES_FOUND * trend.n_segments
            if len(np.unique(series.epoch)) < need:
                raise DegenerateError(
                    f"finding {trend.find} breaks needs exposures of at least {need} dates, but "
                    f"there are {len(np.unique(series.epoch))}",
                    where=series.source,
                    do="give the dates of the breaks",
                )
            return
        segment = self.segment(series.epoch)[0]
        limits = (-np.inf, *trend.breaks, np.inf)
        for s, (first, last) in enumerate(pairwise(limits)):
            epoch = series.epoch[segment == s]
            need = trend.form.least
            if len(epoch) < need or (need > 1 and np.ptp(epoch) == 0):
                raise DegenerateError(
                    f"the segment from {first:g} to {last:g} has {len(epoch)} exposures of "
                    f"{len(np.unique(epoch))} dates, and trend {trend.kind!r} needs {need}",
                    where=series.source,
                    do="remove this break",
                )

    # -- scales -----------------------------------------------------------------------------------

    @cached_property
    def reference(self) -> Float:
        """Reference date (S,) of each segment in decimal years."""
        trend, epoch = self.trend, self.series.epoch
        if trend.reference:
            return np.broadcast_to(np.array(trend.reference, float), (trend.n_segments,)).copy()
        if trend.find:
            return np.full(trend.n_segments, epoch.mean())
        segment = self.segment(epoch)[0]
        return np.array([epoch[segment == s].mean() for s in range(trend.n_segments)])

    @cached_property
    def years(self) -> float:
        """Unit of time of the columns in years: half the span of the series."""
        return float(np.ptp(self.series.epoch)) / 2 or 1.0

    @cached_property
    def drift(self) -> Drift | None:
        """Random part of the trend; None if it has none."""
        form = self.trend.form
        if not form.knots:
            return None
        return Drift.over(self.series.epoch, form.knots, smooth=form.smooth)

    @property
    def n_groups(self) -> int:
        """Number of groups of the series; 1 if it has no groups."""
        return max(len(self.series.group_names), 1)

    @property
    def n_fixed(self) -> int:
        """Number of columns with a vague prior on their parameters: trend, then groups."""
        each = 2 if self.trend.groups == "slopes" else 1
        return self.trend.n_columns + each * (self.n_groups - 1)

    @property
    def n_columns(self) -> int:
        """Total number of columns: the fixed ones, then those of the random part."""
        return self.n_fixed + (self.drift.n_columns if self.drift else 0)

    # -- columns ----------------------------------------------------------------------------------

    def given_breaks(self) -> Float:
        """Dates of the given breaks, shape (1, B)."""
        return np.array(self.trend.breaks, float)[None]

    def segment(self, epoch: Float, breaks: Float | None = None) -> Int:
        """Segment number (..., E) of each epoch (E,).

        Parameters
        ----------
        epoch : ndarray, shape (E,)
            Decimal years.
        breaks : ndarray, shape (..., B), optional
            Dates of the breaks in decimal years; those of `trend` by default.

        Returns
        -------
        ndarray of int, shape (..., E)
        """
        rows = self.given_breaks() if breaks is None else breaks
        return (epoch >= rows[..., :, None]).sum(axis=-2)

    def matrix(self, epoch: ArrayLike, group: Int, breaks: Float | None = None) -> Float:
        """Design matrix at given epochs.

        Parameters
        ----------
        epoch : array_like, shape (E,)
            Decimal years.
        group : ndarray of int, shape (E,)
            Index of each exposure's group.
        breaks : ndarray, shape (..., B), optional
            Dates of the breaks, possibly fewer than the trend has; the given ones by default.

        Returns
        -------
        ndarray, shape (..., E, p)
        """
        t = np.asarray(epoch, float)
        rows = self.given_breaks() if breaks is None else breaks
        segment = self.segment(t, rows)
        n = rows.shape[-1] + 1
        inside = (segment[..., None] == np.arange(n)).astype(float)
        constant = np.ones((*segment.shape, 1))
        since = ((t - self.reference[segment]) / self.years)[..., None]
        form = self.trend.form
        parts = [inside if form.levels else constant]
        if form.slopes == "one":
            parts.append(since)
        elif form.slopes == "each":
            parts.append(inside * since)
        elif form.slopes == "kinks":
            after = np.maximum(t[:, None] - rows[..., None, :], 0.0) / self.years
            since_start = ((t - self.reference[0]) / self.years)[:, None] * constant
            parts += [since_start, after]
        if self.n_groups > 1:
            member = (group[:, None] == np.arange(1, self.n_groups)).astype(float)
            parts.append(member * constant)
            if self.trend.groups == "slopes":
                middle = self.series.epoch.mean()
                parts.append(member * constant * ((t - middle) / self.years)[:, None])
        if self.drift:
            parts.append(self.drift.columns(t) * constant)
        return np.concatenate(parts, axis=-1)

    def lines(self, b: Float, breaks: Float) -> tuple[Float, Float]:
        """Level at the reference date and slope per year of each segment.

        Parameters
        ----------
        b : ndarray, shape (n, k, p)
            Parameters of the columns.
        breaks : ndarray, shape (n, B) or (1, B)
            Dates of the breaks.

        Returns
        -------
        level, slope : ndarray, shape (n, S, k)
            Values for the first group, without the random part of the trend.
        """
        s, n, slopes = self.trend.n_segments, self.trend.n_levels, self.trend.form.slopes
        rows = np.swapaxes(b, 1, 2)  # (n, p, k)
        flat = np.zeros((len(b), s, b.shape[1]))
        if slopes == "none":
            return rows[:, :n].copy(), flat
        if slopes != "kinks":
            per_segment = rows[:, n : n + (s if slopes == "each" else 1)]
            return rows[:, :n].copy(), flat + per_segment / self.years
        slope = np.cumsum(rows[:, 1 : s + 1], axis=1) / self.years
        level = flat + rows[:, :1]
        # line of the first segment at each reference date, plus the contribution of each kink
        level += slope[:, :1] * (self.reference - self.reference[0])[:, None]
        for k in range(s - 1):
            kink = (slope[:, k + 1] - slope[:, k])[:, None]
            later = self.reference[k + 1 :] - breaks[:, k : k + 1]
            level[:, k + 1 :] += kink * np.broadcast_to(later, (len(b), s - 1 - k))[..., None]
        return level, slope
