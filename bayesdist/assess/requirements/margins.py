"""Margins by which a solution meets requirements, and what follows from them for the user.

`judge` compares draws of the position error with the limit of each requirement. If a requirement is
not met, `required_reduction` finds the error term that needs the smallest reduction. For a model
with a drift, `validity_period` gives the probability of meeting a requirement as a function of the
epoch, with the drift extrapolated, and so how long the calibration remains valid.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from html import escape
from itertools import count

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.assess.domain import EvaluationDomain, WorstPosition
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.requirements.requirement import Requirement
from bayesdist.assess.requirements.verdict import (
    MISSED_BELOW,
    Tally,
    counting_error,
    undecided_by_draws,
    verdict_of,
)
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import AmbiguousTerm, VaryingTerm
from bayesdist.assess.units import convert
from bayesdist.diagnose.statistics import clopper_pearson
from bayesdist.errors import InputError
from bayesdist.model import Chip, DistortionModel
from bayesdist.model.grid import DEFAULT_GRID
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import LARGER, Check, doubts_of
from bayesdist.utils.text import counted, probability_words, rounded

EPOCHS = 9  # number of evenly spaced epochs, with both ends, at which a range is judged
MOST_DRAWS = 512_000  # 99.9 % of verdicts are right 0.001 from the required probability 0.95
DRAWS_AT_ONCE = 32_000  # number of draws added at a time, to limit memory
DRAWS = 1000  # number of draws, sufficient for a factor accurate to one or two percent
STEPS = 9  # number of bisections of the interval that contains the factor
CANDIDATES = 12  # number of terms, the largest, of which a reduction is tried
BAND = 0.95  # level of the interval of a probability


@dataclass(frozen=True, eq=False)
class Margin:
    """Margin of a solution relative to a requirement. All lengths are in `unit`.

    Parameters
    ----------
    requirement : Requirement
    value : float
        Median of the statistic over the draws.
    interval : tuple of float
        Central 95 % interval of the statistic over the draws.
    margin : float
        The limit minus the quantile of the statistic at the required probability. It is
        non-negative if and only if `probability_met` is at least the required probability.
    probability_met : float
        Probability that the known errors meet the limit: the fraction of draws that do not exceed
        it. It may be 1 for an 'undecided' verdict, for example if the residuals were not examined
        or no catalogue error is stated, because such errors are not in the draws.
    mc_error : float
        Monte-Carlo standard error of `probability_met`.
    verdict : str
        'met' if the limit is met with the required probability; 'missed' if it is exceeded with a
        probability of at least 0.95; 'not shown' if neither; 'undecided' if there are doubts that
        the probability does not include.
    reason : str
        Reason for the verdict.
    unit : str
        Unit of the requirement.
    epoch : float or None
        Decimal year for which the requirement was judged; the worst one of a range of epochs.
    n_effective : float
        Effective number of independent draws.
    draws : ndarray, shape (n,)
        Statistic of each of the requested draws; over a range of epochs the largest one. Close to
        the required probability, the other results use more draws than these.
    worst : WorstPosition
        Position with the largest error at that epoch; its rms is in `unit`.
    rests_on : tuple of str
        Assumptions and measurements that the verdict depends on.
    remedy : RequiredReduction or None
        The term that must be reduced, and to what size, for the requirement to be met; None if it
        is met or undecided.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> rng = np.random.default_rng(1)
    >>> matches, truth = simulate_wise(500, rng=rng)
    >>> model = bd.build_model(matches, order=2, size=(1016, 1016))
    >>> fit = bd.fit_linear(matches, model)
    >>> need = bd.Requirement("field-wide", "p95", 1.0)
    >>> (margin,) = bd.check_requirements(fit, [need], grid=(5, 3), n_draws=400, rng=rng)
    >>> margin.value < need.limit
    True
    """

    requirement: Requirement
    value: float
    interval: tuple[float, float]
    margin: float
    probability_met: float
    mc_error: float
    verdict: str
    reason: str
    unit: str
    epoch: float | None
    n_effective: float
    draws: Float
    worst: WorstPosition
    remedy: RequiredReduction | None = None
    rests_on: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"Margin({self.sentence})"

    def __str__(self) -> str:
        return self.sentence

    def _repr_html_(self) -> str:
        verdict, sentence = escape(self.verdict), escape(self.sentence)
        return f"<p>{sentence.replace(verdict, f'<b>{verdict}</b>', 1)}</p>"

    @property
    def sentence(self) -> str:
        """Requirement, verdict, value, limit, probability and reason in one line."""
        r = self.requirement
        when = "" if self.epoch is None else f" in {self.epoch:.2f}"
        scope = f" {r.scope}" if r.scope else ""
        qualifier = " by the known errors alone" if self.verdict == "undecided" else ""
        value = rounded(self.value, (self.interval[1] - self.interval[0]) / 4)
        return (
            f"{r.name}: {self.verdict}: {r.statistic}{scope}{when} {value} {r.unit}, "
            f"limit {r.limit:g} {r.unit}, {self.probability_words}{qualifier}, "
            f"{r.probability:g} asked for: "
            f"{self.reason}"
        )

    @property
    def probability_words(self) -> str:
        """Probability of meeting the limit, in ASCII: 'P = 0.953 +- 0.004' or 'P > 0.9993'."""
        return probability_words(self.probability_met, self.mc_error, self.n_effective)

    @property
    def percent(self) -> float:
        """The margin as a percentage of the limit."""
        return 100.0 * self.margin / self.requirement.limit


def judge(
    errors: DrawnErrors,
    requirements: Sequence[Requirement],
    *,
    grid: tuple[int, int] = DEFAULT_GRID,
    epoch: float | None = None,
    chip: int | None = None,
    pixel_scale: float | None = None,
    checks: Sequence[Check] = (),
    adaptive: bool = True,
) -> tuple[Margin, ...]:
    """Judge requirements on drawn errors.

    Parameters
    ----------
    errors : DrawnErrors
    requirements : sequence of Requirement
    grid : tuple of int
        Number of points along x and y of each chip.
    epoch, chip : float and int, optional
        Epoch in decimal years and chip number, for requirements that name none; all chips by
        default.
    pixel_scale : float, optional
        Size of one pixel in mas.
    checks : sequence of Check
        Checks, including that of convergence; doubts that they raise make verdicts undecided.
    adaptive : bool
        True to add draws if the probability of meeting the limit is close to the required one, or
        to that of a missed limit. The number of draws is doubled until the verdict does not depend
        on Monte-Carlo error, or reaches `MOST_DRAWS`. The added draws are determined by the seed of
        the first ones.

    Returns
    -------
    tuple of Margin
        In the order of the requirements.

    Raises
    ------
    InputError
        See `check_requirements`.
    """
    if not requirements:
        return ()
    model, unit = errors.solution.model, errors.unit
    requirements = [r.in_unit_of(unit) for r in requirements]
    for r in requirements:
        convert(r.limit, r.unit, unit, pixel_scale, where=r.where)
    factors = [convert(1.0, unit, r.unit, pixel_scale) for r in requirements]
    cases = [domains_of(r, model, grid, epoch=epoch, chip=chip) for r in requirements]
    doubts = doubts_of(checks)
    tallies = _tallied(errors, requirements, cases, factors, grid, doubts, adaptive=adaptive)
    first, other = _ways(errors, grid)
    ways, margins = (*first, *other), []
    terms = [term for way in (*first[:1], *other[:1]) for term in way.terms]
    names = (t.rows[0].name for t in terms if isinstance(t, VaryingTerm) and t.varies)
    varying = list(dict.fromkeys(names))
    for r, case, factor, (by_epoch, by_way) in zip(
        requirements, cases, factors, tallies, strict=True
    ):
        extremes = [
            _margin(r, case, by_epoch[k], way, factor, by_way[k], doubts)
            for k, way in enumerate(ways)
        ]
        worse = min(range(len(ways)), key=lambda k: extremes[k].probability_met)
        by_cause = extremes[: len(first)], extremes[len(first) :]
        margin = _of_extremes(by_cause, extremes[worse], varying, doubts)
        if extremes[worse].verdict in ("missed", "not shown") and not doubts:
            worst_epoch = next(domain for domain in case if domain.epoch == margin.epoch)
            remedy = required_reduction(ways[worse], r, worst_epoch, factor)
            margin = replace(margin, remedy=remedy)
        margins.append(margin)
    return tuple(margins)


def _ways(
    errors: DrawnErrors, grid: tuple[int, int]
) -> tuple[tuple[DrawnErrors, ...], tuple[DrawnErrors, ...]]:
    """Draws in which errors of unknown extent or cause have each of the possible ones.

    Returns two tuples: draws in which terms of unknown cause have the first cause, and those in
    which they have the alternative cause.  Each has one item per treatment of the errors that may
    vary over the field. The second tuple is empty if no term has an alternative cause.
    """
    first = (errors, *errors.treatments(grid))
    terms = tuple(
        (isinstance(term, AmbiguousTerm) and term.alternative) or term for term in errors.terms
    )
    if terms == errors.terms:
        return first, ()
    other = errors.with_terms(terms)
    return first, (other, *other.treatments(grid))


def _tallied(
    errors: DrawnErrors,
    requirements: Sequence[Requirement],
    cases: Sequence[tuple[EvaluationDomain, ...]],
    factors: Sequence[float],
    grid: tuple[int, int],
    doubts: Sequence[Check],
    *,
    adaptive: bool,
) -> list[tuple[list[list[Float]], list[Tally]]]:
    """Statistics of each requirement, with more draws if Monte-Carlo error would decide a verdict.

    For each requirement returns two lists with one item per way in which errors may vary over the
    field: the statistic (n,) of the first draws at each epoch, and the tally of all draws.
    """
    batch, total, out = errors, 0, list[tuple[list[list[Float]], list[Tally]]]()
    undecided = list(range(len(requirements)))
    for number in count(1):
        first, other = _ways(batch, grid)
        ways = (*first, *other)
        wanted: dict[EvaluationDomain, set[str]] = {}
        for i in undecided:
            for domain in cases[i]:
                wanted.setdefault(domain, set()).add(requirements[i].statistic)
        statistics = {}
        for domain, names in wanted.items():
            owner = next(i for i in undecided if domain in cases[i])
            with _named(requirements[owner]):  # its separation or magnitude may be invalid
                statistics[domain] = [way.statistics(domain, sorted(names)) for way in ways]
        for i in undecided:
            r = requirements[i]
            by_epoch = [
                [factors[i] * statistics[domain][k][r.statistic] for domain in cases[i]]
                for k in range(len(ways))
            ]
            if number == 1:
                out.append((by_epoch, [Tally(r.limit) for _ in ways]))
            for tally, draws, way in zip(out[i][1], by_epoch, ways, strict=True):
                tally.add(np.max(draws, axis=0), way.pools)
        total += batch.n_draws
        undecided = [
            i
            for i in undecided
            if _more_draws_decide(out[i][1], requirements[i].probability, errors.n_draws, doubts)
        ]
        if not (adaptive and undecided and errors.further and total < MOST_DRAWS):
            return out
        n_more = min(total, max(errors.n_draws, DRAWS_AT_ONCE), MOST_DRAWS - total)
        batch = errors.further(n_more, number)
    raise AssertionError("the loop returns")


def _more_draws_decide(
    tallies: Sequence[Tally], asked: float, n_first: int, doubts: Sequence[Check]
) -> bool:
    """True if a verdict is open because there are too few draws, and more could settle it.

    `tallies`: tallies for each way in which errors may vary. `asked`: required probability.
    `n_first`: requested number of draws. `doubts`: if these may make errors smaller, no verdict can
    be settled; if they only make errors larger, only a missed requirement can.
    """
    if any(check.doubt != LARGER for check in doubts):
        return False
    fractions = [tally.fraction for tally in tallies]
    bounds = [(int(np.argmax(fractions)), MISSED_BELOW)]  # missed in every way
    if not doubts:
        bounds.append((int(np.argmin(fractions)), asked))  # met in every way
    for k, bound in bounds:
        now, n_limit = tallies[k].effective()
        if not undecided_by_draws(fractions[k], now, [bound]):
            continue
        # the covariance of draws from the same sets is estimated well from a few draws of each
        if tallies[k].n < 4 * n_first or not undecided_by_draws(fractions[k], n_limit, [bound]):
            return True
    return False


def domains_of(
    requirement: Requirement,
    model: DistortionModel,
    grid: tuple[int, int],
    *,
    epoch: float | None = None,
    chip: int | None = None,
) -> tuple[EvaluationDomain, ...]:
    """Domains in which a requirement is judged, one for each epoch.

    `grid`: number of points along x and y of a chip. `epoch`, `chip`: for a requirement that names
    none. Raises InputError if the chip is unknown, the epoch is missing, a range of epochs is given
    although nothing depends on time, a polygon does not name its chip among several, or a region
    contains fewer than four grid points.
    """
    r = requirement
    epochs: list[float | None] = [r.epoch if r.epoch is not None else epoch]
    if r.epochs is not None:
        if model.time is None:
            raise InputError(
                "it names a range of epochs, but the model does not depend on time",
                where=r.where,
                do="leave epochs out, or give the model time-dependent terms",
            )
        start, stop = r.epochs
        inner = [b for b in model.time.breaks if start < b < stop]
        # at a break the later drift applies; just before it the earlier drift has run longest
        before = [float(np.nextafter(b, start)) for b in inner]
        epochs = [*sorted({*np.linspace(start, stop, EPOCHS).tolist(), *inner, *before})]
    elif epochs[0] is None and model.time is not None:
        raise InputError(
            "the model depends on time, but no epoch is given",
            where=r.where,
            do="give the requirement an epoch, or set assess.epoch",
        )
    chips = _chips_of(r, model, chip, epochs[0])
    if not isinstance(r.region, str) and len(chips) > 1:
        raise InputError(
            "a polygon lies on one chip, but all chips are judged",
            where=r.where,
            do=f"name its chip, one of {', '.join(str(c.number) for c in chips)}",
        )
    with _named(r):  # its region may be invalid
        first = EvaluationDomain.of_chips(
            model,
            grid,
            chips=[c.number for c in chips],
            region=r.region,
            epoch=epochs[0],
            magnitude=r.magnitude,
            relative=r.relative,
            separation=r.separation,
        )
    return tuple(first.at(epoch) for epoch in epochs)


@contextmanager
def _named(requirement: Requirement) -> Iterator[None]:
    """Context manager that adds the requirement's name to an InputError."""
    try:
        yield
    except InputError as error:
        location = f"{requirement.where}, {error.where}"
        raise InputError(error.cause, where=location, do=error.do) from None


def _chips_of(
    requirement: Requirement, model: DistortionModel, chip: int | None, epoch: float | None
) -> tuple[Chip, ...]:
    """The chips on which a requirement is judged."""
    number = chip if requirement.chip is None else requirement.chip
    if requirement.chip is not None and number not in [c.number for c in model.chips]:
        raise InputError(
            f"there is no chip {number}",
            where=requirement.where,
            do=f"name one of {', '.join(str(c.number) for c in model.chips)}, or leave out chip to "
            "judge all of them",
        )
    if number is None:
        return model.chips
    return (place_of(model, epoch=epoch, chip=number).chip,)


def _of_extremes(
    by_cause: tuple[Sequence[Margin], Sequence[Margin]],
    worse: Margin,
    names: Sequence[str],
    doubts: Sequence[Check],
) -> Margin:
    """The least favourable margin, `worse`, with a verdict that is valid for all margins.

    `by_cause` are margins with unmodelled structure of the detector, and with structure of the
    catalogue; the latter are empty if the cause is known.  `names` are those of errors that may
    vary over the field.
    """
    margins = [m for of_cause in by_cause for m in of_cause]
    better = max(margins, key=lambda m: m.probability_met)
    if all(m.verdict == worse.verdict for m in margins) or worse.verdict == "undecided":
        return worse
    unknown = []
    verdicts = [{m.verdict for m in of_cause} for of_cause in by_cause if of_cause]
    if any(of_cause != verdicts[0] for of_cause in verdicts):
        unknown.append(
            "whether the unmodelled structure is the detector's or the catalogue's, "
            "which the residuals do not tell (state the catalogue's errors by [catalogue], or add "
            "exposures that point elsewhere)"
        )
    if any(len(of_cause) > 1 for of_cause in verdicts):
        vary = "varies" if len(names) == 1 else "vary"
        unknown.append(
            f"how {' and '.join(names)} {vary} over the field (as one offset, a smooth field, or "
            "independent errors)"
        )
    reason = f"it depends on {', and on '.join(unknown)}: "
    reason += f"P(met) is {_fraction(worse)} to {_fraction(better)}"
    if doubts:
        texts = [*(check.sentence for check in doubts), reason]
        return replace(worse, verdict="undecided", reason="; ".join(texts))
    reason += f"; in the least favourable form {worse.reason}"
    return replace(worse, verdict="not shown", reason=reason)


def _fraction(margin: Margin) -> str:
    """Probability of meeting the limit, as text."""
    return counted(margin.probability_met, margin.mc_error, margin.n_effective)


def _margin(
    requirement: Requirement,
    case: Sequence[EvaluationDomain],
    by_epoch: Sequence[Float],
    errors: DrawnErrors,
    factor: float,
    tally: Tally,
    doubts: Sequence[Check],
) -> Margin:
    asked = requirement.probability
    draws = tally.all_values
    worst_epoch = case[int(np.argmax([np.quantile(d, asked) for d in by_epoch]))]
    met, (n_effective, _) = tally.fraction, tally.effective()
    low, median, high = np.quantile(draws, [0.025, 0.5, 0.975])
    # empirical quantile without interpolation, so that it is consistent with `met`
    reached = np.quantile(draws, asked, method="inverted_cdf")
    verdict, reason = verdict_of(met, n_effective, asked, doubts)
    axis = requirement.statistic[0] if requirement.statistic[:2] in ("u_", "v_") else ""
    position = errors.worst(worst_epoch, axis)
    return Margin(
        requirement=requirement,
        value=float(median),
        interval=(float(low), float(high)),
        margin=float(requirement.limit - reached),
        probability_met=met,
        mc_error=counting_error(met, n_effective),
        verdict=verdict,
        reason=reason,
        unit=requirement.unit,
        epoch=worst_epoch.epoch,
        n_effective=n_effective,
        draws=tally.values[0],
        worst=replace(position, rms=factor * position.rms),
    )


@dataclass(frozen=True)
class RequiredReduction:
    """The error term that must be reduced to meet a requirement."""

    # the term that needs the smallest reduction if one term is sufficient; else the largest term
    term: str
    factor: float  # factor by which its error must be multiplied; 0 if it is not sufficient
    now: float  # its radial rms over the positions judged, in the unit of the requirement
    needed: float  # radial rms that it may have
    enough: bool  # True if the requirement is then met with the other terms unchanged
    unit: str

    @property
    def sentence(self) -> str:
        """Required reduction in one sentence."""
        if not self.enough:
            return (
                f"no term can do it alone: the largest, {self.term} ({self.now:.3g} {self.unit} "
                "radial rms), could vanish and the requirement would still not be met"
            )
        return (
            f"it would be met if {self.term} fell from {self.now:.3g} to {self.needed:.3g} "
            f"{self.unit} radial rms, all else being as it is"
        )


def required_reduction(
    errors: DrawnErrors, requirement: Requirement, domain: EvaluationDomain, factor: float
) -> RequiredReduction | None:
    """Find the term that needs the smallest reduction for a requirement to be met.

    Each of the largest terms in turn is multiplied by a number between 0 and 1, with the same draws
    throughout.

    `domain`: positions at the worst epoch. `factor`: size of the solution's unit in the unit of the
    requirement. Returns None if the requirement is met with the draws used here.
    """
    n = min(DRAWS, errors.n_draws)
    statistic = requirement.statistic

    def met(term: str, size: float) -> bool:
        statistics = errors.statistics(domain, [statistic], scale={term: size}, n_draws=n)
        return bool(
            np.mean(factor * statistics[statistic] <= requirement.limit) >= requirement.probability
        )

    if met("", 1.0):  # met with these draws, so that no reduction can be stated
        return None
    sizes = {name: factor * size for name, size in errors.sizes(domain).items()}
    candidates = sorted(sizes, key=lambda name: -sizes[name])[:CANDIDATES]
    largest = candidates[0]
    best, best_factor = "", 0.0
    for name in candidates:
        # terms that need a larger reduction than the best one so far are skipped
        if sizes[name] > 0 and met(name, best_factor):
            low, high = 0.0, 1.0
            for _ in range(STEPS):
                middle = (low + high) / 2
                low, high = (middle, high) if met(name, middle) else (low, middle)
            if not best or low > best_factor:
                best, best_factor = name, low
    if not best:
        return RequiredReduction(largest, 0.0, sizes[largest], 0.0, False, requirement.unit)
    now = sizes[best]
    return RequiredReduction(best, best_factor, now, best_factor * now, True, requirement.unit)


@dataclass(frozen=True, eq=False)
class ValidityPeriod:
    """Probability of meeting a requirement as a function of epoch."""

    requirement: Requirement
    epoch: Float  # (n,), decimal years, ascending
    probability: Float  # (n,), fraction of draws that meet the limit
    low: Float  # (n,), central 95 % interval for the number of draws (Clopper-Pearson)
    high: Float  # (n,)
    value: Float  # (n,), median of the statistic, in the unit of the requirement

    @property
    def date(self) -> float | None:
        """Date (decimal years) at which the probability falls below the required one.

        None if it does not.
        """
        return self._fall(self.probability)

    @property
    def interval(self) -> tuple[float | None, float | None]:
        """Dates at which the ends of the interval of the probability fall below the required one.

        The earlier date comes first; a date is None if the probability does not fall below.
        """
        return self._fall(self.low), self._fall(self.high)

    @property
    def sentence(self) -> str:
        """Validity period in one sentence."""
        name, asked = self.requirement.name, self.requirement.probability
        first, last = float(self.epoch[0]), float(self.epoch[-1])
        if self.date is None:
            return f"{name}: the probability stays at {asked:g} or more until {last:.1f}"
        if self.date == first:
            p_first = float(self.probability[0])
            return (
                f"{name}: the probability is below {asked:g} already at {first:.1f} ({p_first:.2g})"
            )
        early, late = self.interval
        until = f"{late:.1f}" if late is not None else f"after {last:.1f}"
        since = first if early is None else early
        return f"{name}: recalibrate before {self.date:.1f} ({since:.1f} to {until})"

    def _fall(self, probability: Float) -> float | None:
        below = probability < self.requirement.probability
        if not below.any():
            return None
        k = int(np.argmax(below))
        if k == 0:
            return float(self.epoch[0])
        ends = slice(k - 1, k + 1)
        return float(
            np.interp(
                -self.requirement.probability,  # `interp` needs ascending values
                -probability[ends],
                self.epoch[ends],
            )
        )


def validity_period(
    errors: DrawnErrors,
    requirement: Requirement,
    epochs: ArrayLike,
    *,
    grid: tuple[int, int] = DEFAULT_GRID,
    pixel_scale: float | None = None,
) -> ValidityPeriod:
    """Probability of meeting a requirement as a function of epoch.

    The error at each epoch is that of the drift in the model, extrapolated with its covariance. It
    includes the curvature of the drift that data and prior allow, if the errors contain it.

    `errors`: draws for a model that depends on time; the same draws are used at all epochs, so the
    curve has no Monte-Carlo noise between epochs. `requirement`: its epoch is ignored. `epochs`:
    decimal years, ascending, shape (n,), at least two. `grid`: number of points along x and y of a
    chip. `pixel_scale`: see `check_requirements`.
    """
    at = np.asarray(epochs, float)
    requirement = requirement.in_unit_of(errors.unit)
    factor = convert(1.0, errors.unit, requirement.unit, pixel_scale, where=requirement.where)
    n = errors.n_effective
    single_epoch = replace(requirement, epoch=float(at[0]), epochs=None)
    (domain,) = domains_of(single_epoch, errors.solution.model, grid)
    statistics = errors.over_epochs(domain, [float(epoch) for epoch in at], [requirement.statistic])
    draws = factor * np.array([by_name[requirement.statistic] for by_name in statistics])
    met, value = np.mean(draws <= requirement.limit, axis=1), np.median(draws, axis=1)
    low, high = np.array([clopper_pearson(p, n, BAND) for p in met]).T
    return ValidityPeriod(requirement, at, met, low, high, value)
