"""Does the distortion change with time?  Models and residuals of several periods (WSDC D-T033, C).

One pass over the data gathers all of it: the normal equations of each period, its residuals in bins
about the one model of all data, and which reference stars it has.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bayesdist.data import Matches
from bayesdist.diagnose.residuals.binned import BAND_AXES, BinnedSums, BinValues, band_bins
from bayesdist.diagnose.residuals.misfit import STARS_PER_BIN
from bayesdist.diagnose.residuals.tables import StatisticsTable, period_table
from bayesdist.errors import DegenerateError
from bayesdist.infer import LinearFit
from bayesdist.infer.compare.period_dates import sum_by_period
from bayesdist.infer.compare.periods import (
    PeriodComparison,
    PeriodSums,
    compare_periods,
    sums_of_stars,
)
from bayesdist.infer.compare.positions import PositionChange
from bayesdist.infer.stars.stars import prepare
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import chi2_isf, chi2_sf, f_sf
from bayesdist.utils.limits import DIFFERENCE
from bayesdist.utils.numbers import p_words

MAX_BINS = 45  # along each side, as in Appendix C
COMBINED = "combined"
_FEWEST_STARS = 5


@dataclass(frozen=True)
class PeriodSettings:
    """Periods that are compared, and the limits of the comparison."""

    # begin and end of each period, decimal years, as `sum_by_period`
    spans: Mapping[str, tuple[float, float]]
    bins: int  # on each axis, for the residuals
    radial_weight: float = 1.0  # as the fit's
    # difference of positions that does not matter, in the unit of u, v
    tolerance: float | None = None
    unit_arcsec: float | None = None  # the unit of u, v in arcsec


@dataclass(frozen=True, eq=False)
class PeriodPart:
    """Sums over some pairs of one period; parts of batches of the data add."""

    sums: PeriodSums
    bins: tuple[BinnedSums, ...]  # residuals about the fit of all data, of each chip
    n_rows: int  # pairs, those included that the fit leaves out
    stars: Int  # sorted codes of the reference stars, each once; empty where they are not known

    def __add__(self, other: PeriodPart) -> PeriodPart:
        return PeriodPart(
            self.sums + other.sums,
            tuple(a + b for a, b in zip(self.bins, other.bins, strict=True)),
            self.n_rows + other.n_rows,
            np.union1d(self.stars, other.stars),
        )


@dataclass(frozen=True)
class PatternChange:
    """Means of bins in one period against those in all other periods."""

    period: str
    axis: str
    p_value: float  # probability of as large differences by chance
    rms: float  # of the differences, their noise subtracted; 0 where noise alone is larger
    # between the two patterns, noise included: near 1 where the same structure stays and noise is
    # small
    correlation: float
    n_bins: int  # bins that hold five stars or more in both


@dataclass(frozen=True, eq=False)
class TimeVariation:
    """Comparison of models and residuals of several periods."""

    comparison: PeriodComparison
    spans: Mapping[str, tuple[float, float]]  # begin and end of each period, decimal years
    changes: Mapping[str, PositionChange]  # of each period against the combined model
    # first, last: the earliest and the latest period
    first: str
    last: str
    ends: PositionChange  # the latest against the earliest
    # as Table C-1, of each chip: all periods together, then each; in arcsec where the size of a
    # pixel is known, else in the unit of u, v
    residuals: tuple[StatisticsTable, ...]
    patterns: tuple[tuple[PatternChange, ...], ...]  # of each chip, in the unit of u, v
    tolerance: float | None  # difference of positions that does not matter, in the unit of u, v
    n_outside: int  # pairs outside all periods
    n_repeated: int  # reference stars that several periods have; 0 where stars have no codes

    @property
    def significant(self) -> bool:
        """True where one model of all periods is refuted."""
        return self.comparison.homogeneity[2] < DIFFERENCE.value

    @property
    def is_material(self) -> bool:
        """True where one model is refuted, and not known to be good enough all the same."""
        harmless = self.tolerance is not None and all_below(self.changes, self.tolerance)
        return self.significant and not harmless

    @property
    def verdict(self) -> str:
        """Verdict on a change of the distortion, and on its size."""
        return period_verdict(self.comparison, self.changes, self.tolerance)

    @property
    def pattern_sentence(self) -> str:
        """Verdict on the pattern of the residuals in all periods, as a sentence."""
        found = [one for chip in self.patterns for one in chip]
        least = min(found, key=lambda one: one.p_value)
        p = min(1.0, len(found) * least.p_value)
        if p >= DIFFERENCE.value:
            return (
                "The pattern of the residuals about one model is the same in all periods "
                f"(least of {len(found)} probabilities, times their number: {p:.2g})."
            )
        return (
            f"The pattern of the residuals about one model changes: in {least.period} the means of "
            f"bins differ in {least.axis} by {least.rms:.2g} {self.comparison.model.unit} rms from "
            f"those of the other periods (p = {p:.1g}, of {len(found)} tests)."
        )

    @property
    def cautions(self) -> tuple[str, ...]:
        """Sentences that a reader of the comparison has to know."""
        out = []
        if self.n_outside:
            out.append(
                f"{self.n_outside} pairs lie outside all periods: the combined model is that of "
                "the periods, not of all pairs."
            )
        if self.n_repeated:
            out.append(
                f"{self.n_repeated} reference stars have pairs in several periods: errors of the "
                "catalogue are common to these, and the periods count as independent here."
            )
        return tuple(out)


def bins_for(n: int) -> int:
    """Bins on each axis for so many pairs of the smallest period on a chip."""
    return int(np.clip(np.sqrt(n / STARS_PER_BIN), 2, MAX_BINS))


def period_part(matches: Matches, *, fit: LinearFit, bins: int, radial_weight: float) -> PeriodPart:
    """A task for `sum_by_period`.

    `matches` are those of one period, `fit` is that of all data; `bins` are those on each axis,
    `radial_weight` is the fit's.
    """
    stars, _ = prepare(fit.model, matches)
    used = fit.clip.keeps_of(stars)
    chip = np.repeat(stars.groups.chip, np.diff(stars.starts))
    columns = (*stars.pixels(), *stars.residuals(fit.mean).T)
    return PeriodPart(
        sums=sums_of_stars(stars, fit, radial_weight),
        bins=tuple(
            band_bins(*(a[used & (chip == k)] for a in columns), bins=bins, size=one.size)
            for k, one in enumerate(fit.model.chips)
        ),
        n_rows=len(matches),
        stars=np.zeros(0, np.int64) if matches.star is None else np.unique(matches.star),
    )


def time_variation(
    fit: LinearFit,
    matches: Matches,
    settings: PeriodSettings,
    *,
    rng: np.random.Generator,
) -> TimeVariation:
    """Comparison of periods, in one pass over the data.

    `fit` is that of all data, without frames and time dependence; `matches` have errors and epochs.
    Raises InputError as `sum_by_period` and `compare_periods`, DegenerateError for a period with
    too few pairs.
    """
    periods, unit_arcsec = settings.spans, settings.unit_arcsec
    task = partial(period_part, fit=fit, bins=settings.bins, radial_weight=settings.radial_weight)
    parts: dict[str, PeriodPart] = sum_by_period(matches, periods, task)
    comparison = compare_periods(fit, {name: part.sums for name, part in parts.items()})
    first = min(periods, key=lambda name: periods[name])
    last = max(periods, key=lambda name: periods[name])
    _, seen = np.unique(np.concatenate([p.stars for p in parts.values()]), return_counts=True)
    by_chip = [
        {name: part.bins[k] for name, part in parts.items()} for k in range(len(fit.model.chips))
    ]
    try:
        residuals = tuple(
            _residuals(one, fit.unit, unit_arcsec, rng, fit.model.n_terms) for one in by_chip
        )
        patterns = tuple(pattern_changes(one) for one in by_chip)
    except DegenerateError as error:
        least = min(parts, key=lambda name: parts[name].n_rows)
        raise DegenerateError(
            f"period {least} has {parts[least].n_rows} pairs, too few for mean residuals in bins",
            where="periods",
            do="give longer periods, or leave it out",
        ) from error
    return TimeVariation(
        comparison=comparison,
        spans=dict(periods),
        changes={name: comparison.positions(name, rng=rng) for name in periods},
        first=first,
        last=last,
        ends=comparison.positions(last, first, rng=rng),
        residuals=residuals,
        patterns=patterns,
        tolerance=settings.tolerance,
        n_outside=len(matches) - sum(part.n_rows for part in parts.values()),
        n_repeated=int((seen > 1).sum()),
    )


def _residuals(
    periods: Mapping[str, BinnedSums],
    unit: str,
    unit_arcsec: float | None,
    rng: np.random.Generator,
    n_terms: int,
) -> StatisticsTable:
    """Table C-1: all periods together, then each of them."""
    one, *others = periods.values()
    together = sum(others, start=one)
    rows = {COMBINED: together, **periods}
    # of a part of the stars the model of all takes out the same part of its coefficients
    n_all = float(together.count.sum())
    absorbed = {
        name: max(1, round(n_terms * float(one.count.sum()) / n_all)) for name, one in rows.items()
    }
    table = period_table(rows, rng=rng, arcsec_per_pixel=unit_arcsec or 1.0, absorbed=absorbed)
    return table if unit_arcsec else replace(table, unit=unit)


def all_below(changes: Mapping[str, PositionChange], tolerance: float) -> bool:
    """True if no period differs by more than a tolerance, with two sigma allowed for errors."""
    # the largest value of a noisy field is biased high
    return all(one.largest + 2 * one.sigma <= tolerance for one in changes.values())


def period_verdict(
    comparison: PeriodComparison,
    changes: Mapping[str, PositionChange],
    tolerance: float | None = None,
) -> str:
    """Sentence on the size, significance and importance of the change with time.

    `changes` has every period against the combined model; differences of positions up to
    `tolerance`, in the unit of u, v, do not matter.
    """
    chi2, dof, p = comparison.homogeneity
    # the most significant, not the largest: the shortest period has the largest noise
    name, most = max(changes.items(), key=lambda one: one[1].chi2)
    unit = comparison.model.unit
    head = "The distortion changes" if p < DIFFERENCE.value else "No change is seen"
    out = (
        f"{head} (chi-square {chi2:.4g} for {dof} degrees of freedom, {p_words(p, 2, 1e-12)}): "
        f"{name} differs most from the combined model, by up to {most.largest:.2g} +- "
        f"{most.sigma:.1g} {unit} at ({most.at[0]:.0f}, {most.at[1]:.0f}), where noise alone "
        f"makes {most.noise_median:.2g} (95 %: {most.noise_95:.2g})"
    )
    if tolerance is None:
        return out + "."
    limit = f"the tolerance of {tolerance:g} {unit}"
    if all_below(changes, tolerance):
        return f"{out}; all periods are below {limit}."
    beyond = [
        name
        for name, one in changes.items()
        if one.p_value < DIFFERENCE.value and one.largest - 2 * one.sigma > tolerance
    ]
    if beyond:
        return f"{out}; beyond {limit}: {', '.join(beyond)}."
    return f"{out}; the data do not decide whether a period exceeds {limit}."


def pattern_changes(periods: Mapping[str, BinnedSums]) -> tuple[PatternChange, ...]:
    """Pattern of every period against that of the rest.

    A single period shares its stars with the combined set, the rest does not: differences from the
    rest have independent errors, and those from the combined set are the same, made smaller by the
    share of the rest.

    Periods are disjoint in their stars, two or more, all against one model in pixels; changes are
    those in X and Y of each. Raises DegenerateError when fewer than three bins hold five stars in a
    period and in the rest.
    """
    out = []
    for name in periods:
        one, *others = (sums for other, sums in periods.items() if other != name)
        rest = sum(others, start=one)
        out += [
            _change(name, axis, periods[name].values(axis), rest.values(axis))
            for axis in BAND_AXES[:2]
        ]
    return tuple(out)


def _change(period: str, axis: str, one: BinValues, rest: BinValues) -> PatternChange:
    good = one.good & rest.good & (np.minimum(one.dof, rest.dof) >= _FEWEST_STARS - 1)
    n = int(good.sum())
    if n < 3:
        raise DegenerateError(
            f"only {n} bins hold {_FEWEST_STARS} stars in this period and in the others",
            where=f"period {period!r}",
            do="take fewer bins",
        )
    a, b = one.mean[good], rest.mean[good]
    variance = one.sem[good] ** 2 + rest.sem[good] ** 2
    p_value = _p_value((a - b) ** 2 / variance, one.minus(rest).dof[good])
    excess = float(np.mean((a - b) ** 2 - variance))
    alike = float(np.corrcoef(a, b)[0, 1]) if a.std() > 0 and b.std() > 0 else float("nan")
    return PatternChange(period, axis, p_value, float(np.sqrt(max(excess, 0.0))), alike, n)


def _p_value(t2: Float, dof: Float) -> float:
    """Probability of larger squared t variables (n,), each by its normal variable."""
    z2 = chi2_isf(f_sf(t2, 1, dof), 1)
    return float(chi2_sf(z2.sum(), z2.size))
