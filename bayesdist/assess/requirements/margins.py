"""Requirements on the position error, and by what margin a solution meets them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from html import escape

import numpy as np

from bayesdist.assess.domain import EvaluationDomain, WorstPosition
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.requirements.reduction import RequiredReduction, required_reduction
from bayesdist.assess.requirements.requirement import Requirement
from bayesdist.assess.requirements.verdict import counting_error, verdict_of
from bayesdist.assess.solution import place_of
from bayesdist.assess.units import convert
from bayesdist.errors import InputError
from bayesdist.model import Chip, DistortionModel
from bayesdist.model.grid import DEFAULT_GRID
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import Check, doubts_of

EPOCHS = 9  # of a range that are judged, its ends and what lies evenly between


@dataclass(frozen=True, eq=False)
class Margin:
    """Margin of a solution against a requirement.  All lengths are in `unit`.

    Parameters
    ----------
    requirement : Requirement
    value : float
        Median of the statistic over the draws.
    interval : tuple of float
        Central 95 % of the statistic over the draws.
    margin : float
        The limit minus the value that the statistic stays at or under with the probability asked
        for: not negative exactly where `probability_met` is at least that probability.
    probability_met : float
        Fraction of draws at or under the limit.  It counts the errors that are known and no
        others: it may be 1 where the verdict is 'undecided', because the residuals were not
        examined, for example, or an error of the catalogue is not stated.
    mc_error : float
        Monte-Carlo standard error of `probability_met`.
    verdict : str
        'met', 'missed' or 'undecided'.
    reason : str
        Why, in words.
    unit : str
        The requirement's.
    epoch : float or None
        At which it was judged; of a range of epochs the worst one.
    n_effective : float
        Independent draws that the draws are worth.
    draws : ndarray, shape (n,)
        The statistic of every draw; over a range of epochs the largest.
    worst : WorstPosition
        Where the error is largest, at that epoch; its size in `unit`.
    rests_on : tuple of str
        What the verdict takes for granted or has measured, as clauses.
    remedy : RequiredReduction or None
        The term that must be reduced, and to what level, for the requirement to be met; None where
        it is met, and where there is doubt about all numbers.

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
        """Requirement, verdict, probability and reason in one line."""
        r = self.requirement
        where = "" if self.epoch is None else f" in {self.epoch:.2f}"
        scope = f" {r.scope}" if r.scope else ""
        known = " by the known errors alone" if self.verdict == "undecided" else ""
        return (
            f"{r.name}: {self.verdict}: {r.statistic} at most {r.limit:g} {r.unit}{scope}{where} "
            f"with P = {self.probability_met:.3f}{known}, {r.probability:g} asked for: "
            f"{self.reason}"
        )

    @property
    def percent(self) -> float:
        """The margin in percent of the limit."""
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
) -> tuple[Margin, ...]:
    """Margins of requirements on drawn errors, in the order of the requirements.

    Parameters
    ----------
    errors : DrawnErrors
    requirements : sequence of Requirement
    grid : tuple of int
        Points on x and y of each chip.
    epoch, chip : float and int, optional
        For requirements that name none: decimal years; the chip number, by default all chips.
    pixel_scale : float, optional
        Size of one pixel in mas.
    checks : sequence of Check
        Their doubts keep verdicts from being given; that of convergence is among them.

    Raises
    ------
    InputError
        As `check_requirements`.
    """
    if not requirements:
        return ()
    model, unit = errors.solution.model, errors.unit
    for r in requirements:
        convert(r.limit, r.unit, unit, pixel_scale, where=r.where)
    cases = [domains_of(r, model, grid, epoch=epoch, chip=chip) for r in requirements]
    wanted: dict[EvaluationDomain, set[str]] = {}
    for r, case in zip(requirements, cases, strict=True):
        for domain in case:
            wanted.setdefault(domain, set()).add(r.statistic)
    ways, found = (errors, *errors.treatments(grid)), {}
    for domain, names in wanted.items():
        owner = next(r for r, case in zip(requirements, cases, strict=True) if domain in case)
        with _named(owner):  # its separation or magnitude may be wrong
            found[domain] = [one.statistics(domain, sorted(names)) for one in ways]

    doubts = doubts_of(checks)
    n_effective = errors.n_effective
    varying = [t.rows[0].name for t in errors.terms if getattr(t, "varies", False)]
    margins = []
    for r, case in zip(requirements, cases, strict=True):
        factor = convert(1.0, unit, r.unit, pixel_scale)
        extremes = []
        for k, way in enumerate(ways):
            draws = [factor * found[domain][k][r.statistic] for domain in case]
            extremes.append(_margin(r, case, draws, way, factor, n_effective, doubts))
        worse = min(range(len(ways)), key=lambda k: extremes[k].probability_met)
        margin = _of_extremes(extremes, extremes[worse], varying, doubts)
        if extremes[worse].verdict == "missed" and not doubts:
            worst_epoch = next(one for one in case if one.epoch == margin.epoch)
            remedy = required_reduction(ways[worse], r, worst_epoch, factor)
            margin = replace(margin, remedy=remedy)
        margins.append(margin)
    return tuple(margins)


def domains_of(
    requirement: Requirement,
    model: DistortionModel,
    grid: tuple[int, int],
    *,
    epoch: float | None = None,
    chip: int | None = None,
) -> tuple[EvaluationDomain, ...]:
    """Domains in which a requirement is judged: one for each epoch.

    `grid`: points on x and y of a chip. `epoch`, `chip`: for a requirement that names none.
    InputError for an unknown chip, a missing epoch, a range of epochs where nothing depends on
    time, a polygon that is not said to lie on one of several chips, and a region that holds fewer
    than four points of the grid.
    """
    r = requirement
    epochs: list[float | None] = [r.epoch if r.epoch is not None else epoch]
    if r.epochs is not None:
        if model.time is None:
            raise InputError(
                "it names a range of epochs, and the model does not depend on time",
                where=r.where,
                do="leave epochs out, or give the model time-dependent terms",
            )
        start, stop = r.epochs
        inner = [b for b in model.time.breaks if start < b < stop]
        # a break belongs to what follows it: just before it the earlier drift has run longest
        before = [float(np.nextafter(b, start)) for b in inner]
        epochs = [*sorted({*np.linspace(start, stop, EPOCHS).tolist(), *inner, *before})]
    elif epochs[0] is None and model.time is not None:
        raise InputError(
            "the model depends on time and no epoch is given",
            where=r.where,
            do="give the requirement an epoch, or set assess.epoch",
        )
    chips = _chips_of(r, model, chip, epochs[0])
    if not isinstance(r.region, str) and len(chips) > 1:
        raise InputError(
            "a polygon lies on one chip, and all chips are judged",
            where=r.where,
            do=f"name its chip, one of {', '.join(str(c.number) for c in chips)}",
        )
    with _named(r):  # its region may be wrong
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
    """Context whose errors name the requirement."""
    try:
        yield
    except InputError as error:
        where = f"{requirement.where}, {error.where}"
        raise InputError(error.cause, where=where, do=error.do) from None


def _chips_of(
    requirement: Requirement, model: DistortionModel, chip: int | None, epoch: float | None
) -> tuple[Chip, ...]:
    """The chips whose field is judged."""
    number = chip if requirement.chip is None else requirement.chip
    if requirement.chip is not None and number not in [c.number for c in model.chips]:
        raise InputError(
            f"there is no chip {number}",
            where=requirement.where,
            do=f"name one of {', '.join(str(c.number) for c in model.chips)}, or leave chip out "
            "for all of them",
        )
    if number is None:
        return model.chips
    return (place_of(model, epoch=epoch, chip=number).chip,)


def _of_extremes(
    margins: Sequence[Margin], worse: Margin, names: Sequence[str], doubts: Sequence[Check]
) -> Margin:
    """The least favourable margin, `worse`, with a verdict that holds for all of them."""
    if worse.verdict != "missed" or all(m.verdict == "missed" for m in margins):
        return worse
    better = max(margins, key=lambda m: m.probability_met)
    vary = "varies" if len(names) == 1 else "vary"
    reason = (
        f"it depends on how {' and '.join(names)} {vary} over the field: as one offset, a smooth "
        f"field, or independent errors, P(met) is {worse.probability_met:.3g} to "
        f"{better.probability_met:.3g}"
    )
    texts = [*(one.sentence for one in doubts), reason]
    return replace(worse, verdict="undecided", reason="; ".join(texts))


def _margin(
    requirement: Requirement,
    case: Sequence[EvaluationDomain],
    by_epoch: Sequence[Float],
    errors: DrawnErrors,
    factor: float,
    n_effective: float,
    doubts: Sequence[Check],
) -> Margin:
    asked = requirement.probability
    draws = np.max(by_epoch, axis=0)
    worst_epoch = case[int(np.argmax([np.quantile(d, asked) for d in by_epoch]))]
    met = float(np.mean(draws <= requirement.limit))
    low, median, high = np.quantile(draws, [0.025, 0.5, 0.975])
    # the empirical quantile without interpolation, so that its side of the limit agrees with `met`
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
        draws=draws,
        worst=replace(position, rms=factor * position.rms),
    )
