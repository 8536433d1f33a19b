"""Does the distortion change with time?  Models and residuals of several periods (WSDC D-T033, C).

All sums are accumulated in one pass over the data: the normal equations of each period, its
residuals in bins with respect to the model of all data, and the codes of its reference stars.
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
from bayesdist.infer.compare.periods import (
    PeriodComparison,
    PeriodSums,
    PositionChange,
    compare_periods,
    sum_by_period,
    sums_of_stars,
)
from bayesdist.infer.stars.stars import prepare
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.checks import DIFFERENCE
from bayesdist.utils.distributions import chi2_isf, chi2_sf, f_sf
from bayesdist.utils.text import p_words

MAX_BINS = 45  # along each axis, as in Appendix C
COMBINED = "combined"
_FEWEST_STARS = 5


@dataclass(frozen=True)
class PeriodSettings:
    """Periods that are compared, and the limits of the comparison."""

    # begin and end of each period in decimal years, as for `sum_by_period`
    spans: Mapping[str, tuple[float, float]]
    bins: int  # number per axis, for the residuals
    radial_weight: float = 1.0  # as in the fit
    # difference of positions that is considered harmless, in the unit of u and v
    tolerance: float | None = None
    unit_arcsec: float | None = None  # size of the unit of u and v in arcsec


@dataclass(frozen=True, eq=False)
class PeriodPart:
    """Sums over pairs of one period; sums over batches of the data can be added."""

    sums: PeriodSums
    bins: tuple[BinnedSums, ...]  # residuals from the fit to all data, per chip
    n_rows: int  # number of pairs, including those that the fit rejected
    stars: Int  # sorted unique codes of the reference stars; empty if unknown

    def __add__(self, other: PeriodPart) -> PeriodPart:
        return PeriodPart(
            self.sums + other.sums,
            tuple(a + b for a, b in zip(self.bins, other.bins, strict=True)),
            self.n_rows + other.n_rows,
            np.union1d(self.stars, other.stars),
        )


@dataclass(frozen=True)
class PatternChange:
    """Means of bins in one period compared with those in all other periods."""

    period: str
    axis: str
    p_value: float  # probability of so large differences by chance
    rms: float  # of the differences, with their noise subtracted; 0 if the noise is larger
    # between the two patterns, noise included: near 1 if the structure is constant and the noise is
    # small
    correlation: float
    n_bins: int  # number of bins with at least five stars in both


@dataclass(frozen=True, eq=False)
class TimeVariation:
    """Comparison of models and residuals of several periods."""

    comparison: PeriodComparison
    spans: Mapping[str, tuple[float, float]]  # begin and end of each period, decimal years
    changes: Mapping[str, PositionChange]  # differences of each period from the combined model
    # names of the earliest and the latest period
    first: str
    last: str
    ends: PositionChange  # difference of the latest period from the earliest
    # like Table C-1, per chip: all periods together, then each period; in arcsec if the pixel size
    # is known, otherwise in the unit of u and v
    residuals: tuple[StatisticsTable, ...]
    patterns: tuple[tuple[PatternChange, ...], ...]  # per chip, in the unit of u and v
    # difference of positions that is considered harmless, in the unit of u and v
    tolerance: float | None
    n_outside: int  # number of pairs outside all periods
    n_repeated: int  # number of reference stars in several periods; 0 if stars have no codes

    @property
    def significant(self) -> bool:
        """True if a common model of all periods is rejected."""
        return self.comparison.homogeneity[2] < DIFFERENCE.value

    @property
    def is_material(self) -> bool:
        """True if a common model is rejected and not known to be good enough nevertheless."""
        harmless = self.tolerance is not None and all_below(self.changes, self.tolerance)
        return self.significant and not harmless

    @property
    def verdict(self) -> str:
        """Sentence on a change of the distortion and its size."""
        return period_verdict(self.comparison, self.changes, self.tolerance)

    @property
    def pattern_sentence(self) -> str:
        """Sentence on changes of the pattern of the residuals between periods."""
        changes = [change for chip in self.patterns for change in chip]
        worst = min(changes, key=lambda change: change.p_value)
        p = min(1.0, len(changes) * worst.p_value)
        if p >= DIFFERENCE.value:
            return (
                "The pattern of the residuals about one model is the same in all periods "
                f"(least of {len(changes)} probabilities, times their number: {p:.2g})."
            )
        return (
            f"The pattern of the residuals about one model changes: in {worst.period} the means of "
            f"bins differ in {worst.axis} by {worst.rms:.2g} {self.comparison.model.unit} rms from "
            f"those of the other periods (p = {p:.1g}, of {len(changes)} tests)."
        )

    @property
    def cautions(self) -> tuple[str, ...]:
        """Caveats of the comparison, as sentences."""
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
    """Number of bins per axis for `n` pairs on a chip in the period with the fewest pairs."""
    return int(np.clip(np.sqrt(n / STARS_PER_BIN), 2, MAX_BINS))


def period_part(matches: Matches, *, fit: LinearFit, bins: int, radial_weight: float) -> PeriodPart:
    """Sums over the pairs of one period: a task for `sum_by_period`.

    `matches` are those of the period, `fit` is that of all data; `bins` is the number per axis, and
    `radial_weight` is that of the fit.
    """
    stars, _ = prepare(fit.model, matches)
    used = fit.clip.keeps_of(stars)
    chip = np.repeat(stars.groups.chip, np.diff(stars.starts))
    columns = (*stars.pixels(), *stars.residuals(fit.mean).T)
    return PeriodPart(
        sums=sums_of_stars(stars, fit, radial_weight),
        bins=tuple(
            band_bins(*(a[used & (chip == k)] for a in columns), bins=bins, size=chip_model.size)
            for k, chip_model in enumerate(fit.model.chips)
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
    """Compare periods, in one pass over the data.

    `fit` is that of all data, without frames and time dependence; `matches` must have errors and
    epochs.  Raises InputError like `sum_by_period` and `compare_periods`, and DegenerateError if a
    period has too few pairs.
    """
    periods, unit_arcsec = settings.spans, settings.unit_arcsec
    task = partial(period_part, fit=fit, bins=settings.bins, radial_weight=settings.radial_weight)
    parts: dict[str, PeriodPart] = sum_by_period(matches, periods, task)
    comparison = compare_periods(fit, {name: part.sums for name, part in parts.items()})
    first = min(periods, key=lambda name: periods[name])
    last = max(periods, key=lambda name: periods[name])
    _, n_periods = np.unique(np.concatenate([p.stars for p in parts.values()]), return_counts=True)
    by_chip = [
        {name: part.bins[k] for name, part in parts.items()} for k in range(len(fit.model.chips))
    ]
    try:
        residuals = tuple(
            _residuals(chip_bins, fit.unit, unit_arcsec, rng, fit.model.n_terms)
            for chip_bins in by_chip
        )
        patterns = tuple(pattern_changes(chip_bins) for chip_bins in by_chip)
    except DegenerateError as error:
        fewest = min(parts, key=lambda name: parts[name].n_rows)
        raise DegenerateError(
            f"period {fewest} has {parts[fewest].n_rows} pairs, too few for mean residuals in bins",
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
        n_repeated=int((n_periods > 1).sum()),
    )


def _residuals(
    periods: Mapping[str, BinnedSums],
    unit: str,
    unit_arcsec: float | None,
    rng: np.random.Generator,
    n_terms: int,
) -> StatisticsTable:
    """Table C-1: all periods together, then each period."""
    first, *remaining = periods.values()
    together = sum(remaining, start=first)
    rows = {COMBINED: together, **periods}
    # for a subset of the stars the common model absorbs the same fraction of its coefficients
    n_all = float(together.count.sum())
    absorbed = {
        name: max(1, round(n_terms * float(bins.count.sum()) / n_all))
        for name, bins in rows.items()
    }
    table = period_table(rows, rng=rng, arcsec_per_pixel=unit_arcsec or 1.0, absorbed=absorbed)
    return table if unit_arcsec else replace(table, unit=unit)


def all_below(changes: Mapping[str, PositionChange], tolerance: float) -> bool:
    """True if no period differs by more than a tolerance plus two standard errors."""
    # the largest value of a noisy field is biased high
    return all(change.largest + 2 * change.sigma <= tolerance for change in changes.values())


def period_verdict(
    comparison: PeriodComparison,
    changes: Mapping[str, PositionChange],
    tolerance: float | None = None,
) -> str:
    """Sentence on the size, significance and importance of the change with time.

    `changes` contains every period compared with the combined model; differences of positions up to
    `tolerance`, in the unit of u and v, are considered harmless.
    """
    chi2, dof, p = comparison.homogeneity
    # the most significant change: the largest one may be noise of the shortest period
    name, worst = max(changes.items(), key=lambda change: change[1].chi2)
    unit = comparison.model.unit
    head = "The distortion changes" if p < DIFFERENCE.value else "No change is seen"
    out = (
        f"{head} (chi-square {chi2:.4g} for {dof} degrees of freedom, {p_words(p, 2, 1e-12)}): "
        f"{name} differs most from the combined model, by up to {worst.largest:.2g} +- "
        f"{worst.sigma:.1g} {unit} at ({worst.at[0]:.0f}, {worst.at[1]:.0f}), where noise alone "
        f"makes {worst.noise_median:.2g} (95 %: {worst.noise_95:.2g})"
    )
    if tolerance is None:
        return out + "."
    limit = f"the tolerance of {tolerance:g} {unit}"
    if all_below(changes, tolerance):
        return f"{out}; all periods are below {limit}."
    beyond = [
        name
        for name, change in changes.items()
        if change.p_value < DIFFERENCE.value and change.largest - 2 * change.sigma > tolerance
    ]
    if beyond:
        return f"{out}; beyond {limit}: {', '.join(beyond)}."
    return f"{out}; the data do not decide whether a period exceeds {limit}."


def pattern_changes(periods: Mapping[str, BinnedSums]) -> tuple[PatternChange, ...]:
    """Pattern of every period compared with that of all other periods.

    A single period shares its stars with the combined set, but not with the other periods:
    differences from the latter have independent errors.  Differences from the combined set are the
    same, reduced by the fraction of the other periods.

    The periods, at least two, have no stars in common, and all residuals refer to one model, in
    pixels.  Returns the changes in X and Y of each period.  Raises DegenerateError if fewer than
    three bins contain five stars both in a period and in the others.
    """
    out = []
    for name in periods:
        first, *remaining = (
            sums for name_of_other, sums in periods.items() if name_of_other != name
        )
        other_periods = sum(remaining, start=first)
        out += [
            _change(name, axis, periods[name].values(axis), other_periods.values(axis))
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
    """P-value of squared t variables (n,), each transformed to a normal variable."""
    z2 = chi2_isf(f_sf(t2, 1, dof), 1)
    return float(chi2_sf(z2.sum(), z2.size))
