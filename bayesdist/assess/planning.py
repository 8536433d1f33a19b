"""Number and dates of further exposures that would meet a requirement (preposterior analysis).

The outcome of further exposures is unknown, but today's posterior gives its probability. True
parameters ("truths") are drawn from it. For each of them, the error model of a run with the
existing and the further exposures is predicted, and the requirement is judged with it. The fraction
of truths with which it is met is the probability that it would be met. The prediction is:

- Coefficients: the information of all exposures is used. In a self-calibration each star uses up
  one of its detections, so further exposures of the same stars add more than the existing ones.
- Structure and curvature of the drift, posterior draws z with mean m: with rho times today's data,
  the draws become m + rho / (1 + rho) (t - m) + sqrt(rho) / (1 + rho) (e - m) + (z - m) /
  sqrt(1 + rho), with the truth t and the noise e drawn from the same draws. This is the posterior
  of a linear Gaussian model, and it preserves the law of total variance for any other model. If no
  structure is detected, the prior of its size is nearly flat in its logarithm, and all sizes shrink
  alike. Several exposures of the same date do not constrain the curvature of a drift, which is then
  left unchanged.
- Scatter of exposures: truths are drawn with a prior that is flat in the logarithm above the median
  of the half-Cauchy prior of the run. The draws of the run are weighted by the likelihood of
  deviations drawn with the scatter of the truth. The effect of deviations on the mean of the
  exposures decreases with the square root of the number of exposures (in a self-calibration, it is
  computed for the geometry of the dithers). The deviation of a single exposure does not decrease,
  but its size becomes better known. A limit that is smaller than it is therefore never met, and
  with few exposures this cannot be told.
- Everything else, such as the stated error of a catalogue, is unchanged.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.special import chdtri

from bayesdist.assess.domain import EvaluationDomain, extent, of_sizes, sizes
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.model import ErrorModel
from bayesdist.assess.requirements.margins import domains_of
from bayesdist.assess.requirements.requirement import Requirement
from bayesdist.assess.terms.correlated import Deviations, FieldsOfExposures, StructureErrors
from bayesdist.assess.terms.forms import ErrorDraws, ErrorTerm
from bayesdist.assess.terms.parameters import ExposureVariation, SolutionErrors
from bayesdist.assess.units import convert
from bayesdist.diagnose.correlated.deviations import LINEAR, SCATTERS, LinearDeviations
from bayesdist.diagnose.correlated.exposure_fields import QUADRATIC
from bayesdist.diagnose.correlated.priors import DiscrepancyPriors
from bayesdist.errors import required
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.solution.solution import Solution
from bayesdist.utils.arrays import Bool, Float, Int

TRUTHS = 60  # number of truths
DRAWS = 250  # number of draws of the error model for each truth
MOST_POSITIONS = 60  # sampled positions; the statistic is scaled to its value over all positions
MOST_PAIRS = 300  # sampled pairs of positions
CHANGING = (StructureErrors, Deviations, FieldsOfExposures, ExposureVariation)  # with more data
MOST = 4096  # largest number of exposures that is considered
# The range of the answer contains the numbers with a probability that differs by at most this: the
# largest difference from the fraction of simulated runs that met their limits, which was found for
# single exposures (docs/validation.md).
PROBABILITY_ERROR = 0.2
SMALL = 0.05  # probability of meeting a limit, below which errors are called too large for it


@dataclass(frozen=True)
class ExistingData:
    """Size of the existing data, to which further exposures add.

    Parameters
    ----------
    n_exposures : int
        Number of exposures.
    weight : float
        Sum of the inverse variances per axis over the stars of an average exposure, with variances
        in the unit of u and v squared.
    n_stars : float
        Number of stars in an average exposure.
    gain : float
        Information of a further exposure on the distortion, relative to the average existing one.
        It is larger than 1 for the same stars in a self-calibration, because each star uses up a
        detection only once.
    """

    n_exposures: int
    weight: float
    n_stars: float
    gain: float = 1.0


def with_more_data(z: Float, rho: float, truth: int, noise: int) -> Float:
    """Posterior draws (n, ...) with 1 + rho times today's data, from today's draws `z`.

    `truth` and `noise` are the indices of the draws that are used as the true value and as the
    error of the further data.
    """
    m = z.mean(axis=0)
    moved = (rho * (z[truth] - m) + np.sqrt(rho) * (z[noise] - m)) / (1 + rho)
    return np.asarray(m + moved + (z - m) / np.sqrt(1 + rho))


@dataclass(frozen=True, eq=False)
class Scattering:
    """A term that varies between exposures."""

    in_mean: ErrorDraws | None  # effect on the mean of the exposures
    # including the deviation of a single exposure; None if only the mean of exposures is assessed
    whole: ErrorDraws | None
    # (DRAWS, d), variances of the deviations of an exposure, as mean squares of displacements
    variances: Float
    bends: bool = False  # True if the term includes the curvature of the drift
    # (DRAWS,) probabilities of the draws as truths, up to a factor; None if they are equal
    odds: Float | None = None

    def truth(self, uniform: float) -> int:
        """Index of the draw that is taken as the truth, from a uniform random number in [0, 1)."""
        if self.odds is None:
            return int(uniform * len(self.variances))
        cumulative = np.cumsum(self.odds)
        return int(min(np.searchsorted(cumulative, uniform * cumulative[-1]), len(cumulative) - 1))

    def resized(self, error: Float, rows: Int) -> Float:
        """Errors (DRAWS, N, 2) rescaled to the scatters of the draws `rows` (DRAWS,).

        Each draw keeps its own pattern: a few draws that are chosen again and again would have the
        same few patterns.
        """
        size = np.sqrt(self.variances.sum(axis=1))
        return np.asarray((size[rows] / np.maximum(size, 1e-300))[:, None, None] * error)

    def chosen(self, n: int, data: ExistingData, truth: int, rng: np.random.Generator) -> Int:
        """Indices (DRAWS,) of draws that are probable after n more exposures, given the truth.

        `truth` is the index of the draw that is taken as the truth.

        Deviations are measured with the precision that the stars of an exposure allow. The
        likelihood uses the sum of all scatters, with as many degrees of freedom as there are large
        deviations.
        """
        noise = 1.0 / data.weight
        measured_variances = self.variances + noise
        true = measured_variances[truth]
        effective = float(true.sum() ** 2 / np.sum(true**2))
        dof = n * effective
        size, (uniform, quantile) = measured_variances.mean(axis=1), rng.uniform(size=2)
        # the quantile belongs to a truth and does not change with the number of exposures
        square = size[truth] * chdtri(dof, quantile)
        log = -0.5 * (dof * np.log(size) + square / size)
        weight = np.cumsum(np.exp(log - log.max()))
        # systematic resampling, so that the choice changes little with the weights
        even = (np.arange(len(size)) + uniform) / len(size) * weight[-1]
        return np.minimum(np.searchsorted(weight, even), len(size) - 1)


@dataclass(frozen=True, eq=False)
class Futures:
    """Possible runs with more exposures according to an error model, judged by a requirement.

    Parameters
    ----------
    errors : ErrorModel
        Present error model; it includes the errors of centroids if the requirement has a magnitude.
    requirement : Requirement
    data : ExistingData
        Data that were used for the error model.
    solution : callable
        Function of additional information (d, d) on polynomials and drift that returns the solution
        with this information.
    grid : tuple of int
        Number of points along x and y of each chip.
    epoch : float or None
        Decimal years, for a requirement that names none.
    pixel_scale : float or None
        Size of one pixel in mas.
    seed : int
        Seed of all random numbers.
    priors : DiscrepancyPriors
        Priors that the error model was estimated with.
    """

    errors: ErrorModel
    requirement: Requirement
    data: ExistingData
    solution: Callable[[Float], Solution]
    grid: tuple[int, int]
    epoch: float | None
    pixel_scale: float | None
    seed: int
    priors: DiscrepancyPriors = field(default_factory=DiscrepancyPriors)

    def probability(self, schedule: Schedule) -> Callable[[int], float]:
        """Probability that the requirement is met with n more exposures, as a function of n.

        Truths are the same for any n. A truth that meets the requirement is not evaluated again
        with more exposures, and one that misses it is not evaluated again with fewer.
        """
        met_with, missed_with = np.full(TRUTHS, np.inf), np.zeros(TRUTHS)

        def of(n: int) -> float:
            open_ones = np.flatnonzero((missed_with < n) & (n < met_with))
            met = self.met(schedule, n, open_ones)
            met_with[open_ones[met]] = n
            missed_with[open_ones[~met]] = n
            return float(np.mean(met_with <= n))

        return of

    @one_thread
    def met(self, schedule: Schedule, n: int, truths: Int) -> Bool:
        """Boolean mask (t,) of truths that lead to a met requirement with n more exposures.

        `truths` (t,) are numbers below `TRUTHS`, and `schedule` has the dates of the exposures.
        """
        rho = n / self.data.n_exposures
        several = [self._of_solution(information) for information in schedule.of(n)]
        means = schedule.deviations(n, self.data.n_exposures)
        of_bends = 0.0 if schedule.single_date else rho
        reached = [
            self._probability(several[k % len(several)], means[k % len(several)], n, of_bends, k)
            for k in truths.tolist()
        ]
        return np.array(reached) >= self.requirement.probability

    def _of_solution(self, information: Float) -> list[Float]:
        """Errors (DRAWS, N, 2) of the solution at each place, given additional information."""
        informed = self.solution(information)
        solution = replace(self.errors.solution, solution=informed, without=None, catalogue=())
        drawn = solution.draw(DRAWS, np.random.default_rng([self.seed, 1]))
        return [self._evaluated(drawn, place.positions) for place in self._places]

    def _probability(
        self, solution: Sequence[Float], mean: float, n: int, of_bends: float, truth: int
    ) -> float:
        """Probability of meeting the limit that a run would state for a truth.

        `mean`: effect of exposure deviations on the mean of the exposures, relative to today.
        `of_bends`: amount of further data on the curvature of a drift, relative to today.
        """
        rho = n / self.data.n_exposures
        rhos = [of_bends if bends else self.data.gain * rho for bends in self._bends]
        rng = np.random.default_rng([self.seed, 2, truth])
        true, noise = rng.integers(DRAWS, size=2)
        # relative uncertainty of the scatter of the stars, from their number
        stars = self.data.n_stars * np.array([self.data.n_exposures, n])
        width = np.exp(rng.standard_normal() * np.sqrt(np.sum(0.5 / stars)))
        chosen = [
            term.chosen(n, self.data, term.truth(rng.uniform()), rng) for term in self._scattering
        ]
        values = []
        for place, of_solution in zip(self._places, solution, strict=True):
            error = width * of_solution
            for z, term_rho in zip(place.resolved, rhos, strict=True):
                error += with_more_data(z, term_rho, true, noise)
            for term, (in_mean, deviation), rows in zip(
                self._scattering, place.scattering, chosen, strict=True
            ):
                # the curvature of a drift does not scale with the scatter
                if term.bends:
                    error += in_mean[rows] / np.sqrt(1 + of_bends)
                else:
                    error += mean * term.resized(in_mean, rows)
                error += term.resized(deviation, rows)
            values.append([place.values(error + r) / place.limit for r in place.unchanged])
        worst = np.max(values, axis=0)  # (ways, DRAWS), largest over the epochs
        return float(np.mean(worst <= 1.0, axis=1).min())

    # -- quantities that do not depend on the number of exposures ----------------------------------

    @cached_property
    def _drawn(self) -> DrawnErrors:
        return self.errors.drawn(DRAWS, np.random.default_rng([self.seed, 0]))

    @cached_property
    def _resolved(self) -> list[ErrorDraws]:
        """Draws of terms that data constrain like coefficients: structure and curvature."""
        return [
            draws
            for term, draws in zip(self._drawn.terms, self._drawn.draws, strict=True)
            if _is_resolved(term)
        ]

    @cached_property
    def _bends(self) -> list[bool]:
        """True for each resolved term that is the curvature of the drift."""
        return [isinstance(t, Deviations) for t in self._drawn.terms if _is_resolved(t)]

    @cached_property
    def _scattering(self) -> list[Scattering]:
        terms = [term for term in self._drawn.terms if _scatters(term)]
        rng = np.random.default_rng([self.seed, 3])
        pixel = self.errors.solution.solution.model.pixel_size(self.errors.solution.solution.mean)
        return [_scattering(term, self.priors, pixel, rng) for term in terms]

    @cached_property
    def _places(self) -> list[_Position]:
        drawn = self._drawn
        r = self.requirement.in_unit_of(drawn.unit)
        limit = convert(r.limit, r.unit, drawn.unit, self.pixel_scale)
        ways = [_without(way) for way in (drawn, *drawn.treatments(self.grid))]
        out = []
        for domain in domains_of(r, drawn.solution.model, self.grid, epoch=self.epoch):
            positions, pairs = _some(domain, self.seed)
            place = _Position(
                positions,
                r.statistic,
                pairs,
                limit,
                [self._summed(way, positions) for way in ways],
                [self._evaluated(draws, positions) for draws in self._resolved],
                [self._scattered(term, positions) for term in self._scattering],
            )
            # the statistic over the sampled positions differs from that over all positions
            [over_all] = drawn.statistics(domain, [r.statistic]).values()
            over_some = place.values(self._summed(drawn, positions))
            ratio = float(np.median(over_all) / max(np.median(over_some), 1e-300))
            out.append(replace(place, limit=limit / ratio))
        return out

    def _scattered(self, one: Scattering, positions: EvaluationDomain) -> tuple[Float, Float]:
        """Effect on the exposures' mean, and deviation of a single one, (DRAWS, N, 2) each."""
        nothing = np.zeros((DRAWS, positions.size, 2))
        in_mean = nothing if one.in_mean is None else self._evaluated(one.in_mean, positions)
        combined = in_mean if one.whole is None else self._evaluated(one.whole, positions)
        return in_mean, combined - in_mean

    def _evaluated(self, draws: ErrorDraws, positions: EvaluationDomain) -> Float:
        """Errors (DRAWS, N, 2) of a single term."""
        alone = replace(self._drawn, terms=(), draws=(draws,), further=None, _cache={})
        return self._summed(alone, positions)

    def _summed(self, drawn: DrawnErrors, positions: EvaluationDomain) -> Float:
        """Errors (DRAWS, N, 2) of all drawn terms."""
        shape = DRAWS, positions.size, 2
        normal = np.random.default_rng([self.seed, 4]).standard_normal(shape)
        return drawn.errors(positions)(slice(0, DRAWS), normal)


@dataclass(frozen=True, eq=False)
class _Position:
    """Errors of the terms at the positions of a requirement, at one epoch."""

    positions: EvaluationDomain
    statistic: str
    pairs: Int | None  # (2, P), pairs of positions that are compared
    limit: float  # in the unit of the errors
    # (DRAWS, N, 2) of all terms that more data do not change, for each way in which they may vary
    # over the field
    unchanged: Sequence[Float]
    resolved: Sequence[Float]  # (DRAWS, N, 2) of each term that data constrain like coefficients
    # (DRAWS, N, 2) of each term that varies between exposures: effects on the mean and on a single
    # exposure
    scattering: Sequence[tuple[Float, Float]]

    def values(self, error: Float) -> Float:
        """Statistic of errors (n, N, 2) for each draw."""
        axis, _, base = self.statistic.rpartition("_")
        if self.pairs is None:
            return of_sizes(base, sizes(axis, error))
        if base == "max" and self.positions.separation is None:
            return extent(self.statistic, error)
        return of_sizes(base, sizes(axis, error[:, self.pairs[0]] - error[:, self.pairs[1]]))


def _some(domain: EvaluationDomain, seed: int) -> tuple[EvaluationDomain, Int | None]:
    """Sample of the positions of a domain, and a sample of the pairs of these positions."""
    rng, pairs = np.random.default_rng([seed, 5]), domain.pairs()
    if pairs is None:
        n = min(domain.size, MOST_POSITIONS)
        # evenly spaced in the list of positions, which is ordered by position
        rows = ((np.arange(n) + rng.uniform()) * domain.size / n).astype(int)
    else:
        n = min(pairs.shape[1], MOST_PAIRS)
        pairs = pairs[:, rng.choice(pairs.shape[1], n, replace=False)]
        rows, index = np.unique(pairs, return_inverse=True)
        pairs = index.reshape(pairs.shape)
    points = domain.chip[rows], domain.x[rows], domain.y[rows]
    chosen = replace(domain, chip=points[0], x=points[1], y=points[2], relative="")
    return chosen, pairs


def _is_resolved(term: ErrorTerm) -> bool:
    """True for a term that data constrain like coefficients: structure and curvature."""
    return isinstance(term, CHANGING) and not _scatters(term)


def _scatters(term: ErrorTerm) -> bool:
    """True for a term with a size that is given by the scatter of exposures."""
    if isinstance(term, Deviations):
        return bool(_linear(term).kinds)
    return isinstance(term, FieldsOfExposures | ExposureVariation)


def _odds(*scatters: tuple[Float, float]) -> Float:
    """Ratio (DRAWS,) of a prior that is flat in the logarithm above the median to a half-Cauchy.

    For draws (DRAWS,) of scatters and their prior medians. The half-Cauchy prior resists errors
    that no data show, but scatters are not known to be smaller in most calibrations: with it,
    scatters that few exposures leave open would be expected to turn out small.
    """
    return np.asarray(
        np.prod([np.hypot(1.0, draws / median) for draws, median in scatters], axis=0)
    )


def _scattering(
    term: ErrorTerm, priors: DiscrepancyPriors, pixel: float, rng: np.random.Generator
) -> Scattering:
    """Draws of a term that varies between exposures, in the order of the draws of its scatter.

    `pixel` is the size of a pixel in the unit of u and v.
    """
    in_mean: ErrorDraws | None = None
    in_exposure: ErrorDraws | None = None
    if isinstance(term, Deviations):
        linear = _linear(term)
        rows = np.arange(DRAWS) % len(linear.theta)
        in_mean = term.of_rows(rows, None)
        in_exposure = term.of_rows(rows, int(rng.integers(2**63))) if term.single else None
        by_term = [
            # position in units of the half size of the chip: its mean square is 2 / 3
            (1.0 if kind == "shift" else 2 / 3)
            * (linear.size * linear.scatter[SCATTERS[kind]]) ** 2
            for kind, name in ((kind, SCATTERS[kind]) for kind in linear.kinds)
            for _ in LINEAR.get(kind, "uv")
        ]
        names = {SCATTERS[kind] for kind in linear.kinds}
        odds = _odds(*((linear.scatter[name][rows], priors.exposure) for name in sorted(names)))
        # the scatter of the exposures' mean cannot be distinguished from curvature of the drift
        bends = bool(np.isfinite(linear.epoch))
        return Scattering(in_mean, in_exposure, np.stack(by_term, axis=1)[rows], bends, odds)
    if isinstance(term, FieldsOfExposures):
        fields = required(term.discrepancy.fields, "no fields of exposures were estimated")
        rows = np.arange(DRAWS) % len(fields.theta)
        in_mean = replace(term, single=False).of_rows(rows, rng)
        in_exposure = term.of_rows(rows, rng) if term.single else None
        n_terms = len(QUADRATIC)
        variance = fields.second_order**2 + fields.amplitude**2 / n_terms
        odds = _odds(
            (fields.second_order[rows], priors.higher_order * pixel),
            (fields.amplitude[rows], priors.structure * pixel),
        )
        variances = np.tile(variance[rows, None], (1, 2 * n_terms))
        return Scattering(in_mean, in_exposure, variances, odds=odds)
    if isinstance(term, ExposureVariation):
        rows = np.arange(DRAWS) % len(term.tau)
        half = term.model.pixel_size(term.mean) * max(max(c.size) for c in term.model.chips) / 2
        return Scattering(None, term.of_rows(rows, rng), 2 / 3 * (half * term.tau[rows]) ** 2)
    raise AssertionError(f"{term} does not scatter")


def _linear(term: Deviations) -> LinearDeviations:
    return required(term.discrepancy.linear, "no deviations of exposures were estimated")


def _without(drawn: DrawnErrors) -> DrawnErrors:
    """Draws of the terms that more data do not change."""
    draws = [
        term_draws
        for term, term_draws in zip(drawn.terms, drawn.draws, strict=True)
        if not isinstance(term, (SolutionErrors, *CHANGING))
    ]
    return replace(drawn, terms=(), draws=tuple(draws), further=None, _cache={})


class Further(Protocol):
    """Further exposures whose effects are not proportional to their number."""

    def information(self, n: int) -> Float:
        """Information (d, d) of n exposures on polynomials and drift, or (D, D) on all."""
        ...

    def deviations(self, n: int) -> float:
        """Effect of deviations of all exposures on the polynomials, relative to the present one."""
        ...


@dataclass(frozen=True, eq=False)
class Schedule:
    """Dates of planned exposures."""

    name: str
    # (d, d), information of one exposure on polynomials and drift, averaged over the dates
    information: Float
    single_date: bool = False  # True if all further exposures have the same date
    # equally probable exposures, if their information is not proportional to their number
    together: Sequence[Further] = ()

    def of(self, n: int) -> list[Float]:
        """Information (d, d) of n exposures, as a list of equally probable values."""
        return [further.information(n) for further in self.together] or [n * self.information]

    def deviations(self, n: int, n_existing: int) -> list[float]:
        """Effect of the exposures' deviations on the solution, relative to their present effect.

        There are n more exposures, in addition to `n_existing`. The list has one value for each
        information in the result of `of`.
        """
        independent = float(np.sqrt(n_existing / (n_existing + n)))
        return [further.deviations(n) for further in self.together] or [independent]


@dataclass(frozen=True)
class Need:
    """Number of exposures needed with a schedule.

    Parameters
    ----------
    schedule : str
        Name of the schedule.
    exposures : int or None
        Smallest number with which the requirement is met with the required probability; None if
        `MOST` are not enough.
    probability : float
        Probability that the requirement is met with this number, or with `MOST` if these are not
        enough.
    interval : tuple of (int or None)
        Smallest numbers for a probability that is lower and higher by `PROBABILITY_ERROR`; the
        higher one is at most halfway to 1. None if `MOST` are not enough.
    by_number : mapping of int to float
        Probability that the requirement is met, by number of exposures, ascending.
    """

    schedule: str
    exposures: int | None
    probability: float
    interval: tuple[int | None, int | None] = (0, 0)
    by_number: Mapping[int, float] = field(default_factory=dict)

    @property
    def sentence(self) -> str:
        """Number of exposures needed, in one sentence."""
        if self.exposures == 0:
            return f"{self.schedule}: met as it is (probability {self.probability:.3g})"
        if self.exposures is None:
            large = "is" if self.probability < SMALL else "may be"
            return (
                f"{self.schedule}: with {MOST} more exposures the probability of meeting the limit "
                f"is {self.probability:.3g}: what more data do not make smaller {large} too large"
            )
        low, high = self.interval
        upper = f"more than {MOST}" if high is None else str(high)
        return (
            f"{self.schedule}: {self.exposures} more "
            f"{'exposure' if self.exposures == 1 else 'exposures'}, range {low} to {upper} "
            f"(probability then {self.probability:.3g})"
        )

    @property
    def table(self) -> str:
        """Numbers of exposures that were evaluated, with their probabilities, as text.

        The text is empty if the requirement is already met.
        """
        return ", ".join(f"{n}: {p:.2f}" for n, p in self.by_number.items())


def exposures_needed(
    schedules: Sequence[Schedule],
    probability_of: Callable[[Schedule], Callable[[int], float]],
    asked: float,
    *,
    now: float,
) -> tuple[Need, ...]:
    """Smallest number of exposures of each schedule with which a requirement is met.

    Parameters
    ----------
    schedules : sequence of Schedule
    probability_of : callable
        Function of a schedule that returns a function of the number of exposures, which returns the
        probability that the requirement is met. It must use the same random numbers in each call,
        so that the probability increases with the number of exposures.
    asked : float
        Required probability.
    now : float
        Probability that the limit is met without further exposures.

    Returns
    -------
    tuple of Need
    """
    if now >= asked:
        return tuple(Need(schedule.name, 0, now) for schedule in schedules)
    return tuple(_need(schedule.name, probability_of(schedule), asked) for schedule in schedules)


def _need(name: str, probability_met: Callable[[int], float], asked: float) -> Need:
    probabilities = dict[int, float]()

    def reached(n: int) -> float:
        if n not in probabilities:
            probabilities[n] = probability_met(n)
        return probabilities[n]

    def fewest(probability: float) -> int | None:
        enough = 1
        while reached(enough) < probability:  # doubling, because most needs are small
            if enough == MOST:
                return None
            enough *= 2
        numbers = range(enough // 2 + 1, enough + 1)
        return numbers[bisect_left(numbers, probability, key=reached)]

    n = fewest(asked)
    high = min(asked + PROBABILITY_ERROR, (1 + asked) / 2)
    interval = fewest(asked - PROBABILITY_ERROR), None if n is None else fewest(high)
    return Need(
        name, n, reached(MOST if n is None else n), interval, dict(sorted(probabilities.items()))
    )
