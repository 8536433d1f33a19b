"""Preposterior analysis: whether a requirement would be met with more exposures.

What more data would show is not known, but today's posterior says how probable it is.  Truths are
drawn from it; for each of them the error model is predicted that a run with the exposures at hand
and further ones would have, and the requirement is judged by it:

- coefficients: their information is that of all exposures.  In a self-calibration each star takes
  up one of its detections: further exposures of the same stars say more than those at hand.
- structure and curvature of the drift, posterior draws z about a mean m: with rho times today's
  data, the draws are m + rho / (1 + rho) (t - m) + sqrt(rho) / (1 + rho) (e - m) + (z - m) /
  sqrt(1 + rho), where the truth t and the noise e are themselves draws.  This is the posterior of a
  linear Gaussian model, and it keeps the law of total variance for any other.  Where nothing is
  seen, the prior of the size is nearly flat in its logarithm, and all sizes shrink alike.  Several
  exposures of one date do not show how a drift bends, and leave its curvature as it is.
- scatter of exposures: its draws are weighted by the likelihood of deviations that are drawn with
  the scatter of the truth.  Their effect on the mean of the exposures falls as the root of the
  number of exposures (in a self-calibration, as the variance of the solution times that root).
  The deviation of a single exposure stays as large as it is: it only becomes better known, so that
  a limit that is too small for it is never met, and of few exposures nobody knows whether it is.
- everything else, as what is stated of a catalogue, stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtri

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.model import ErrorModel
from bayesdist.assess.planning.exposures import Schedule
from bayesdist.assess.requirements.margins import domains_of
from bayesdist.assess.requirements.requirement import Requirement
from bayesdist.assess.statistics import extent, of_sizes, sizes
from bayesdist.assess.terms.correlated import Deviations, FieldsOfExposures, StructureErrors
from bayesdist.assess.terms.forms import ErrorDraws, ErrorTerm
from bayesdist.assess.terms.parameters import ExposureVariation
from bayesdist.assess.terms.solution import SolutionErrors
from bayesdist.assess.units import convert
from bayesdist.diagnose.correlated.deviations import LINEAR, SCATTERS, LinearDeviations
from bayesdist.diagnose.correlated.exposure_fields import QUADRATIC
from bayesdist.errors import required
from bayesdist.infer.compare.frame_fields import mean_squares
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.solution.solution import Solution
from bayesdist.utils.arrays import Bool, Float, Int

TRUTHS = 60
DRAWS = 250  # of the error model that each truth leads to
MOST_POSITIONS = 60  # that stand for all: the statistic is scaled by what it is over all of them
MOST_PAIRS = 300
CHANGING = (StructureErrors, Deviations, FieldsOfExposures, ExposureVariation)  # with more data


@dataclass(frozen=True)
class Data:
    """Size of the data at hand, of which further exposures bring more.

    Parameters
    ----------
    n_exposures : int
    weight : float
        Sum over the stars of an average exposure of the inverse variance of an axis, in the unit of
        u and v.
    n_stars : float
        Stars in an average exposure.
    gain : float
        Information of a further exposure about the distortion, relative to the average one at hand:
        of the same stars in a self-calibration it is larger, as these take up detections once.
    """

    n_exposures: int
    weight: float
    n_stars: float
    gain: float = 1.0


def with_more_data(z: Float, rho: float, truth: int, noise: int) -> Float:
    """Posterior draws (n, ...) with 1 + rho times today's data, from those of today.

    `truth` and `noise` are the numbers of the draws that are taken for the truth, and for the error
    of the further data.
    """
    m = z.mean(axis=0)
    moved = (rho * (z[truth] - m) + np.sqrt(rho) * (z[noise] - m)) / (1 + rho)
    return np.asarray(m + moved + (z - m) / np.sqrt(1 + rho))


@dataclass(frozen=True, eq=False)
class Scattering:
    """A term that scatters from exposure to exposure."""

    in_mean: ErrorDraws | None  # effect on the mean of the exposures, by draws
    # with the deviation of a single exposure; None if only the mean of exposures is assessed
    whole: ErrorDraws | None
    # (DRAWS, d), variances of the deviations of an exposure: mean squares of displacements
    variances: Float
    bends: bool = False  # True if the term has the curvature of the drift, too

    def chosen(self, n: int, data: Data, truth: int, rng: np.random.Generator) -> Int:
        """Draws (DRAWS,) that n more exposures make probable if one of them is the truth.

        Deviations are measured as well as the stars of an exposure allow.  What they say of all
        scatters together counts, with as many degrees of freedom as large deviations have.
        """
        noise = 1.0 / data.weight
        known = self.variances + noise
        true = known[truth]
        effective = float(true.sum() ** 2 / np.sum(true**2))
        dof = n * effective
        size, (uniform, quantile) = known.mean(axis=1), rng.uniform(size=2)
        # by its quantile, which belongs to a truth whatever the number of exposures
        square = size[truth] * chdtri(dof, quantile)
        log = -0.5 * (dof * np.log(size) + square / size)
        weight = np.cumsum(np.exp(log - log.max()))
        # evenly spaced, so that the choice changes little with the weights
        even = (np.arange(len(size)) + uniform) / len(size) * weight[-1]
        return np.minimum(np.searchsorted(weight, even), len(size) - 1)


@dataclass(frozen=True, eq=False)
class Futures:
    """Runs with more exposures that are probable by an error model, judged by a requirement.

    Parameters
    ----------
    errors : ErrorModel
        As it is now; with the errors of centroids, where the requirement is of a magnitude.
    requirement : Requirement
    data : Data
        What the error model rests on.
    solution : callable
        Solution that has the additional information (d, d) about polynomials and drift.
    grid : tuple of int
        Points on x and y of each chip.
    epoch : float or None
        Decimal years, for a requirement that names none.
    pixel_scale : float or None
        Size of one pixel in mas.
    seed : int
    """

    errors: ErrorModel
    requirement: Requirement
    data: Data
    solution: Callable[[Float], Solution]
    grid: tuple[int, int]
    epoch: float | None
    pixel_scale: float | None
    seed: int

    def probability(self, schedule: Schedule) -> Callable[[int], float]:
        """Probability that the requirement is met with n more exposures, as a function of n.

        Truths are the same for any n, and one that leads to a requirement that is met is not looked
        at again with more exposures, nor one that leads to a missed requirement with fewer.
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
        """Boolean mask (t,) of the truths that lead to a requirement met with n more exposures.

        `truths` (t,) are numbers below `TRUTHS`.
        """
        rho = n / self.data.n_exposures
        several = [self._of_solution(information) for information in schedule.of(n)]
        # deviations of exposures move the solution by its variance times their sum
        means = [1 / np.sqrt(1 + rho)] * len(several)
        if schedule.together:
            now = self._of_solution(0 * schedule.of(n)[0]).variance
            means = [np.sqrt(1 + rho) * one.variance / now for one in several]
        of_bends = 0.0 if schedule.single_date else rho
        reached = [
            self._probability(several[k % len(several)], means[k % len(several)], n, of_bends, k)
            for k in truths.tolist()
        ]
        return np.array(reached) >= self.requirement.probability

    def _of_solution(self, information: Float) -> _SolutionErrors:
        """Errors of the parameters with additional information about them."""
        more = self.solution(information)
        solution = replace(self.errors.solution, solution=more, without=None, catalogue=())
        drawn = solution.draw(DRAWS, np.random.default_rng([self.seed, 1]))
        square = mean_squares(more.model) * np.diag(more.cov)[: more.model.n_polynomial]
        errors = [self._evaluated(drawn, place.positions) for place in self._places]
        return _SolutionErrors(errors, float(square.sum()))

    def _probability(
        self, solution: _SolutionErrors, mean: float, n: int, of_bends: float, truth: int
    ) -> float:
        """Probability of meeting the limit that a run would state for a truth.

        `mean` is the size of what the mean of the exposures' deviations does, relative to today,
        and `of_bends` the amount of further data on the curvature of a drift.
        """
        rho = n / self.data.n_exposures
        rhos = [of_bends if bends else self.data.gain * rho for bends in self._bends]
        rng = np.random.default_rng([self.seed, 2, truth])
        true, noise = rng.integers(DRAWS, size=2)
        # the scatter of the stars is known as well as they are many
        stars = self.data.n_stars * np.array([self.data.n_exposures, n])
        width = np.exp(rng.standard_normal() * np.sqrt(np.sum(0.5 / stars)))
        chosen = [one.chosen(n, self.data, true, rng) for one in self._scattering]
        values = []
        for place, of_solution in zip(self._places, solution.errors, strict=True):
            error = width * of_solution
            for z, more in zip(place.resolved, rhos, strict=True):
                error += with_more_data(z, more, true, noise)
            for one, (in_mean, own), rows in zip(
                self._scattering, place.scattering, chosen, strict=True
            ):
                size = 1 / np.sqrt(1 + of_bends) if one.bends else mean
                error += size * in_mean[rows] + own[rows]
            values.append([place.values(error + r) / place.limit for r in place.unchanged])
        worst = np.max(values, axis=0)  # (ways, DRAWS), over the epochs
        return float(np.mean(worst <= 1.0, axis=1).min())

    # -- what does not depend on the number of exposures ------------------------------------------

    @cached_property
    def _drawn(self) -> DrawnErrors:
        return self.errors.drawn(DRAWS, np.random.default_rng([self.seed, 0]))

    @cached_property
    def _resolved(self) -> list[ErrorDraws]:
        """Terms that data determine as they do coefficients: structure and curvature."""
        return [
            draws
            for term, draws in zip(self._drawn.terms, self._drawn.draws, strict=True)
            if _is_resolved(term)
        ]

    @cached_property
    def _bends(self) -> list[bool]:
        """True for each of the resolved terms that is the curvature of the drift."""
        return [isinstance(t, Deviations) for t in self._drawn.terms if _is_resolved(t)]

    @cached_property
    def _scattering(self) -> list[Scattering]:
        terms = [term for term in self._drawn.terms if _scatters(term)]
        return [_scattering(term, np.random.default_rng([self.seed, 3])) for term in terms]

    @cached_property
    def _places(self) -> list[_Place]:
        drawn = self._drawn
        r = self.requirement.in_unit_of(drawn.unit)
        limit = convert(r.limit, r.unit, drawn.unit, self.pixel_scale)
        ways = [_without(way) for way in (drawn, *drawn.treatments(self.grid))]
        out = []
        for domain in domains_of(r, drawn.solution.model, self.grid, epoch=self.epoch):
            positions, pairs = _some(domain, self.seed)
            place = _Place(
                positions,
                r.statistic,
                pairs,
                limit,
                [self._summed(way, positions) for way in ways],
                [self._evaluated(draws, positions) for draws in self._resolved],
                [self._scattered(one, positions) for one in self._scattering],
            )
            # of all positions the statistic is another one than of those that stand for them
            [over_all] = drawn.statistics(domain, [r.statistic]).values()
            over_some = place.values(self._summed(drawn, positions))
            ratio = float(np.median(over_all) / max(np.median(over_some), 1e-300))
            out.append(replace(place, limit=limit / ratio))
        return out

    def _scattered(self, one: Scattering, positions: EvaluationDomain) -> tuple[Float, Float]:
        """Effect on the mean of the exposures, and deviation of a single one (DRAWS, N, 2)."""
        nothing = np.zeros((DRAWS, positions.size, 2))
        in_mean = nothing if one.in_mean is None else self._evaluated(one.in_mean, positions)
        whole = in_mean if one.whole is None else self._evaluated(one.whole, positions)
        return in_mean, whole - in_mean

    def _evaluated(self, draws: ErrorDraws, positions: EvaluationDomain) -> Float:
        """Errors (DRAWS, N, 2) of one term."""
        alone = replace(self._drawn, terms=(), draws=(draws,), further=None, _cache={})
        return self._summed(alone, positions)

    def _summed(self, drawn: DrawnErrors, positions: EvaluationDomain) -> Float:
        """Errors (DRAWS, N, 2) of all terms that were drawn."""
        shape = DRAWS, positions.size, 2
        normal = np.random.default_rng([self.seed, 4]).standard_normal(shape)
        return drawn.errors(positions)(slice(0, DRAWS), normal)


@dataclass(frozen=True, eq=False)
class _SolutionErrors:
    """Errors of the parameters of a solution."""

    errors: Sequence[Float]  # (DRAWS, N, 2) at each place
    variance: float  # mean square over the detector, of the polynomials


@dataclass(frozen=True, eq=False)
class _Place:
    """Errors of the terms at the positions of a requirement, at one epoch."""

    positions: EvaluationDomain
    statistic: str
    pairs: Int | None  # (2, P), whose differences count
    limit: float  # in the unit of the errors
    # (DRAWS, N, 2) of all that more data do not change, for each way in which it varies over the
    # field
    unchanged: Sequence[Float]
    resolved: Sequence[Float]  # (DRAWS, N, 2) of each term that data determine
    # (DRAWS, N, 2) of each term that scatters: its effect on the mean, and on a single exposure
    scattering: Sequence[tuple[Float, Float]]

    def values(self, error: Float) -> Float:
        """The statistic of errors (n, N, 2) for each draw."""
        axis, _, base = self.statistic.rpartition("_")
        if self.pairs is None:
            return of_sizes(base, sizes(axis, error))
        if base == "max" and self.positions.separation is None:
            return extent(self.statistic, error)
        return of_sizes(base, sizes(axis, error[:, self.pairs[0]] - error[:, self.pairs[1]]))


def _some(domain: EvaluationDomain, seed: int) -> tuple[EvaluationDomain, Int | None]:
    """Positions that stand for all of a domain, and pairs of them that stand for all pairs."""
    rng, pairs = np.random.default_rng([seed, 5]), domain.pairs()
    if pairs is None:
        n = min(domain.size, MOST_POSITIONS)
        # evenly over the list of positions, in which neighbours follow each other
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
    """True for a term that data determine as they do coefficients: structure and curvature."""
    return isinstance(term, CHANGING) and not _scatters(term)


def _scatters(term: ErrorTerm) -> bool:
    """True for a term whose size is that of a scatter of exposures."""
    if isinstance(term, Deviations):
        return bool(_linear(term).kinds)
    return isinstance(term, FieldsOfExposures | ExposureVariation)


def _scattering(term: ErrorTerm, rng: np.random.Generator) -> Scattering:
    """Draws of a term that scatters, in the order of the draws of its scatter."""
    in_mean: ErrorDraws | None = None
    whole: ErrorDraws | None = None
    if isinstance(term, Deviations):
        linear = _linear(term)
        rows = np.arange(DRAWS) % len(linear.theta)
        in_mean = term.of_rows(rows, None)
        whole = term.of_rows(rows, int(rng.integers(2**63))) if term.single else None
        variances = [
            # of a position in half sizes: its square is 2 / 3 on average
            (1.0 if kind == "shift" else 2 / 3)
            * (linear.size * linear.scatter[SCATTERS[kind]]) ** 2
            for kind, name in ((kind, SCATTERS[kind]) for kind in linear.kinds)
            for _ in LINEAR.get(kind, "uv")
        ]
        # what the mean of the exposures leaves of their scatter is not told from a bend here
        return Scattering(
            in_mean, whole, np.stack(variances, axis=1)[rows], bool(np.isfinite(linear.epoch))
        )
    if isinstance(term, FieldsOfExposures):
        fields = required(term.discrepancy.fields, "no fields of exposures were estimated")
        rows = np.arange(DRAWS) % len(fields.theta)
        in_mean = replace(term, single=False).of_rows(rows, rng)
        whole = term.of_rows(rows, rng) if term.single else None
        n_terms = len(QUADRATIC)
        variance = fields.second_order**2 + fields.amplitude**2 / n_terms
        return Scattering(in_mean, whole, np.tile(variance[rows, None], (1, 2 * n_terms)))
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
        one
        for term, one in zip(drawn.terms, drawn.draws, strict=True)
        if not isinstance(term, (SolutionErrors, *CHANGING))
    ]
    return replace(drawn, terms=(), draws=tuple(draws), further=None, _cache={})
