"""Questions of the score tests: functions that a model may lack, each with its wording.

The list serves matched stars, campaigns and self-calibrations.  The functions of the detections
that a question adds to the model determine everything else: how parameters and stars are projected
out of them, the statistic, its p-value and the smallest effect that would have been detected.

A test of many directions is insensitive to each of them.  Where the likely effect is known, its
patterns are tested one by one in addition.  Trails of charge displace stars along one axis, in
proportion to the number of pixels to the amplifier, and more so the fainter they are; stars that
are so bright that they change the field in the silicon are displaced in proportion to their flux;
fields at the edges of the silicon displace stars outwards or inwards.
The p-values of all these tests, p_i, are combined into one (Liu and Xie 2020):

    p = 1/2 - arctan(t) / pi        t = sum of w_i tan((1/2 - p_i) pi)        sum of w_i = 1

Small values of it are exact for tests that depend on each other in any way: patterns that resemble
each other count as one, whereas a Bonferroni correction would count them all.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise

import numpy as np
from numpy.polynomial import legendre
from scipy.linalg import block_diag

from bayesdist.diagnose.score.result import LOOK_UP_TABLE, Family, Outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.diagnose.statistics import MIN_P, combined_p
from bayesdist.model.basis import MAX_ORDER, n_terms, polynomial_terms
from bayesdist.model.timedep import TimeDependence
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.distributions import chi2_isf, f_isf

Terms = tuple[tuple[int, int], ...]
CONSTANT, LINEAR = polynomial_terms(0), polynomial_terms(1)
HIGHER = 2  # orders above the model's that are tested
OUTSIDE = 0.5  # per cent of the values at either end that are clipped to the remaining range
MIN_AT_EDGES = 200  # detections, so that each margin contains some
MIN_OF_PHASES = 200  # detections, so that each pixel phase is covered
FEWEST_DIGITS = 5  # decimals of a pixel: with so many digits, missing digits displace nothing
WHOLE = 1e-6  # of the last digit: tolerance for equality of a number and its rounded value
# smallest fraction of the detections with few digits, and of those with more
MIN_CUT_OFF = 0.05
# largest fraction of numbers with one digit more that end in 0 by chance; 0.1 on average
BY_CHANCE = 0.3
NEAR_EDGE = 0.05  # of half a side: scale length over which the edge functions decay
SHORTEST = 0.1  # years; shortest time span in which a drift is tested
# smallest fraction of a direction's information that must remain after projecting out the
# parameters
INDEPENDENT = 1e-6
# as `INDEPENDENT`, for drifts: frames absorb them except for the curvature of the polynomial
OWN_OF_TIME = 0.02
MAGNITUDE = Family(
    "magnitude",
    "cut the faint stars, or correct the charge-transfer efficiency",
    "the residuals go with the magnitude of the stars",
    "the residuals do not go with the magnitude of the stars",
)
COLOUR = Family(
    "colour",
    "select a narrower range of colours, or calibrate ranges of colours one by one",
    "the residuals go with the colour of the stars",
    "the residuals do not go with the colour of the stars",
)
POINTING = Family(
    "pointing",
    "give the true detector.scale_mas, by which tangent planes are taken to one",
    "the distortion goes with where exposures point, as if a curved sky were taken as flat",
    "the distortion does not go with where exposures point",
)
EDGES = Family(
    "edges",
    f"leave out the margins of the detector, or {LOOK_UP_TABLE}",
    "the residuals rise towards the edges of the detector",
    "the residuals do not rise towards the edges of the detector",
)
PIXEL_PHASE = Family(
    "pixel phase",
    "correct the centroids for it, as an effective point-spread function does",
    "the residuals go with the position of the stars within their pixel",
    "the residuals do not go with the position of the stars within their pixel",
)
CUT_OFF = Family(
    "cut-off positions",
    "give all pixel coordinates with all of their digits, or add half a step to those that were "
    "cut off",
    "stars whose pixel coordinates have few digits are displaced from the others",
    "stars whose pixel coordinates have few digits are not displaced from the others",
)
MAGNITUDE_IN_TIME = Family(
    "magnitude in time",
    "cut the faint stars, correct the charge-transfer efficiency, or leave out the late years",
    "how the residuals go with the magnitude of the stars changes with time",
    "how the residuals go with the magnitude of the stars does not change with time",
)
DRIFT = Family(
    "drift",
    "add time-dependent terms to model.tdd",
    "linear terms drift with time, and the model's do not",
    "no drift of the linear terms is left in the residuals",
    explained_by="exposures",
)
CURVATURE = Family(
    "curvature in time",
    "give model.tdd a break, or shorter periods",
    "the time dependence is not linear",
    "no curvature of the time dependence is left in the residuals",
    held_by="curvature",
    explained_by="exposures",
)
# smallest standard deviation of values, in magnitudes or in units of half the time span
MIN_DEVIATION = 1e-9
SAYS_NOTHING = 0.2  # p-value above which an adjusted test counts as insignificant
# weight of the test of all directions, when its p-value is combined with those of single patterns
WEIGHT_OF_ALL = 0.5


@dataclass(frozen=True, eq=False)
class Products:
    """Functions of the detections: polynomial terms multiplied by a value per detection.

    Each function displaces both axes of each chip independently, or only along a given direction.
    """

    terms: Terms  # powers (i, j) of Legendre polynomials over the chip
    values: Float | None = None  # (N,) factors of the terms; 1 by default
    # (2,) or (2, N) displacement along the detector axes; directions on the sky are converted with
    # `ScoredSample.along_detector`
    direction: Float | None = None


@dataclass(frozen=True, eq=False)
class Pattern:
    """A combination of functions of the detections that a likely effect has on each chip."""

    products: tuple[Products, ...]  # f functions without directions
    combination: Float  # (2 f, 1) of both axes of the first function, of the second, ...


@dataclass(frozen=True, eq=False)
class Question:
    """Functions of the detections that a model may lack and that are tested together."""

    family: Family
    products: tuple[Products, ...]
    # fraction of its information that a direction must keep when the parameters are projected out
    least: float = INDEPENDENT
    # group of families that a second test fits as well; if that test is insignificant, its result
    # is used
    adjusted_for: str = ""
    # likely patterns, which are also tested one by one
    patterns: tuple[Pattern, ...] = ()


def order_family(total: int, order: int) -> Family:
    """Wording of the test for terms of the order `total`, for a model of the order `order`."""
    return Family(
        f"order {total}",
        f"raise model.order to {total}" if total <= MAX_ORDER else LOOK_UP_TABLE,
        f"the residuals hold terms of order {total}, and the model ends at order {order}",
        f"no terms of order {total} are left in the residuals",
        group="orders",
        held_by="structure",
        denial="the missing order does not explain it",
    )


def questions(sample: ScoredSample) -> Iterator[Question]:
    """Iterate over the questions that a sample can answer; constant values are removed later."""
    order = sample.model.order
    for total in range(order + 1, order + HIGHER + 1):
        terms = polynomial_terms(total)[n_terms(total - 1) :]
        yield Question(order_family(total, order), (Products(terms),))
    if sample.mag is not None:
        magnitude = Products(LINEAR, _standing_out(sample.mag))
        flux = Products(LINEAR, _standing_out(_relative_flux(sample.mag)))
        rising = tuple(_rising_from_edges())
        patterns = tuple(Pattern((part,), way) for part in (magnitude, flux) for way in rising)
        yield Question(MAGNITUDE, (magnitude,), patterns=patterns)
    if sample.offset is not None and sample.position is not None:
        # effect, to first order, of a curved sky on the tangent planes of exposures
        p, q = sample.position
        values = [square * along for square in (p * p, p * q, q * q) for along in sample.offset]
        yield Question(POINTING, tuple(Products(CONSTANT, value) for value in values))
    if not sample.has_catalogue:
        return  # without a catalogue the scatter for the remaining questions is unknown
    if sample.colour is not None:
        yield Question(COLOUR, (Products(LINEAR, _standing_out(sample.colour)),))
    if len(sample) >= MIN_AT_EDGES:
        near = [np.exp((s * Z - 1.0) / NEAR_EDGE) for Z in (sample.X, sample.Y) for s in (-1, 1)]
        edges = tuple(Products(CONSTANT, value - value.mean()) for value in near)
        outwards = tuple(Pattern(edges, combination) for combination in _outwards())
        # missing orders rise towards the edges as well
        yield Question(EDGES, edges, adjusted_for="orders", patterns=outwards)
    if len(sample) >= MIN_OF_PHASES:
        yield Question(PIXEL_PHASE, tuple(Products(CONSTANT, wave) for wave in _phases(sample)))
    if cut_off := tuple(
        Products(CONSTANT, indicator - indicator.mean()) for indicator in _few_digits(sample)
    ):
        yield Question(CUT_OFF, cut_off)
    yield from _of_time(sample)


def _from_edge(sample: ScoredSample) -> Float:
    """Distance (2, N) in pixels of each detection from the edge of the first column and row."""
    size = np.array([chip.size for chip in sample.model.chips])[sample.chip]
    return np.stack([sample.X + 1.0, sample.Y + 1.0]) / 2 * size.T


def _few_digits(sample: ScoredSample) -> Iterator[Float]:
    """Iterate over indicators (N,) of detections that have fewer digits in x, or in y, than others.

    There is at most one for each axis, and none if all values have the same number of digits.
    """
    for distance in _from_edge(sample):
        has_digits = []
        for digits in range(FEWEST_DIGITS + 1):
            shifted = (distance + 0.5) * 10.0**digits
            has_digits.append(np.abs(shifted - np.round(shifted)) < WHOLE)
        for fewer, one_digit_more in pairwise(has_digits):
            share = fewer.mean()
            if (
                MIN_CUT_OFF <= share <= 1 - MIN_CUT_OFF
                and share > BY_CHANCE * one_digit_more.mean()
            ):
                yield fewer.astype(float)
                break


def _phases(sample: ScoredSample) -> Iterator[Float]:
    """Iterate over sine and cosine (N,) of the pixel phase of each detection in x and y.

    A wave with a period of one pixel is too short for the test of repeating patterns, which would
    see it as noise.
    """
    for distance in _from_edge(sample):
        phase = 2 * np.pi * distance
        for wave in (np.sin(phase), np.cos(phase)):
            yield wave - wave.mean()


def _of_time(sample: ScoredSample) -> Iterator[Question]:
    """Iterate over the questions to detections of several dates."""
    time, epoch = sample.model.time, sample.epoch
    if epoch is None or np.ptp(epoch) <= SHORTEST:
        return
    # time scaled to the interval from -1 to 1
    half = (2 * epoch - epoch.min() - epoch.max()) / np.ptp(epoch)
    if sample.mag is not None:
        values = _standing_out(sample.mag) * half
        yield Question(MAGNITUDE_IN_TIME, (Products(LINEAR, values),))
    yield Question(DRIFT, (Products(LINEAR, half - half.mean()),), OWN_OF_TIME)
    if time is not None and len(np.unique(epoch)) > 2:
        order = max([1, *(i + j for _, i, j in time.terms)])
        products = Products(polynomial_terms(order), _beyond_lines(half, time, epoch))
        yield Question(CURVATURE, (products,), OWN_OF_TIME)


def _standing_out(values: Float) -> Float:
    """Values minus their mean, with outliers such as codes for missing data clipped."""
    low, high = np.percentile(values, [OUTSIDE, 100 - OUTSIDE])
    inside = np.clip(values, low, high)
    return np.asarray(inside - inside.mean())


def _relative_flux(mag: Float) -> Float:
    """Flux (N,) relative to that of the brightest stars, whose magnitudes may be codes."""
    brightest = np.percentile(mag, OUTSIDE)
    return np.asarray(10.0 ** (-0.4 * np.maximum(mag - brightest, 0.0)))


def _beyond_lines(half: Float, time: TimeDependence, epoch: Float) -> Float:
    """Square of the time, minus its fit by a constant and by the linear segments of the model."""
    design = np.column_stack([np.ones(len(half)), time.weights(epoch)])
    dates, of = np.unique(half, return_inverse=True)
    first = np.unique(of, return_index=True)[1]
    weight = np.sqrt(np.bincount(of))
    coefficients = np.linalg.lstsq(weight[:, None] * design[first], weight * dates**2)[0]
    return half**2 - design @ coefficients


@dataclass(frozen=True, eq=False)
class Regressors:
    """Directions that one test adds to the model on every chip: functions along its axes."""

    family: Family
    functions: Int  # (f,) indices into the functions of `TestedFunctions`
    # (2 f, q) components of each direction: both axes of the first function, of the second, ...
    combination: Float
    least: float  # see `Question`
    # indices of functions that are fitted as well, so that they are not mistaken for the tested
    # ones
    adjusted_for: Int
    is_pattern: bool = False  # True for one of the likely patterns of a question

    @property
    def every(self) -> Int:
        """Indices of all functions, the tested ones first."""
        return np.concatenate([self.functions, self.adjusted_for])

    def own(self, n_chips: int) -> Bool:
        """Boolean mask of the tested columns: both axes of every function on `n_chips` chips."""
        mask = np.arange(len(self.every)) < len(self.functions)
        return np.tile(np.repeat(mask, 2), n_chips)

    def directions(self, n_chips: int) -> Float:
        """Tested combinations on `n_chips` chips, with separate coefficients for each chip."""
        return np.asarray(np.kron(np.eye(n_chips), self.combination), float)


@dataclass(frozen=True, eq=False)
class TestedFunctions:
    """Functions of the detections: those of the model and those that the tests add."""

    sample: ScoredSample
    # without directions; the first product contains the model's functions
    products: tuple[Products, ...]
    regressors: tuple[Regressors, ...]

    @cached_property
    def terms(self) -> tuple[tuple[int, int], ...]:
        """Powers (i, j) of every function."""
        return tuple(term for product in self.products for term in product.terms)

    @property
    def n_added(self) -> int:
        """Number of functions that the tests add to those of the model."""
        return len(self.terms) - self.sample.model.n_terms

    @property
    def mean_square(self) -> Float:
        """Mean square (L,) of every function over the detector and the detections."""
        i, j = np.array(self.terms).T
        sizes = [
            np.full(
                len(product.terms), 1.0 if product.values is None else np.mean(product.values**2)
            )
            for product in self.products
        ]
        return np.concatenate(sizes) / ((2 * i + 1) * (2 * j + 1))

    @cached_property
    def _tables(self) -> tuple[Float, Float]:
        """Legendre polynomials (order + 1, N) of both coordinates."""
        X, Y = self.sample.X, self.sample.Y
        order = int(np.max(self.terms))
        P, Q = (np.asarray(legendre.legvander(z, order).T, float) for z in (X, Y))
        return P, Q

    @cached_property
    def _distinct(self) -> tuple[Int, Int, list[Int]]:
        """Powers i and j of the distinct terms, and the indices of these for each product.

        The terms of the model come first.
        """
        index = {term: k for k, term in enumerate(dict.fromkeys(self.terms))}
        i, j = np.array(list(index), np.int64).T
        return (
            i,
            j,
            [np.array([index[term] for term in product.terms]) for product in self.products],
        )

    def polynomials(self, rows: slice) -> Float:
        """Values (K, n) of the model's functions at the given detections."""
        K = self.sample.model.n_terms
        P, Q = self._tables
        i, j, _ = self._distinct
        return np.asarray(P[i[:K], rows] * Q[j[:K], rows])

    def at(self, rows: slice | Int) -> Float:
        """Values (L, n) of all functions at the given detections."""
        i, j, term_indices = self._distinct
        P, Q = (table[:, rows] for table in self._tables)
        distinct = P[i] * Q[j]
        return np.concatenate(
            [
                distinct[terms]
                if product.values is None
                else distinct[terms] * product.values[rows]
                for product, terms in zip(self.products, term_indices, strict=True)
            ]
        )


def functions_for(sample: ScoredSample, asked: Iterable[Question] | None = None) -> TestedFunctions:
    """Functions for the questions `asked`; by default for all that the sample can answer."""
    products = [Products(polynomial_terms(sample.model.order))]
    start = len(products[0].terms)
    regressors: list[Regressors] = []
    groups: dict[str, list[Int]] = {}
    for question in questions(sample) if asked is None else asked:
        if all(
            p.values is not None and np.std(p.values) < MIN_DEVIATION for p in question.products
        ):
            continue
        parts, combination = _along_axes(question.products, len(sample))
        functions = start + np.arange(sum(len(part.terms) for part in parts))
        products += parts
        start += len(functions)
        groups.setdefault(question.family.group, []).append(functions)
        none = np.zeros(0, np.int64)
        of_question = [Regressors(question.family, functions, combination, question.least, none)]
        known = {question.products: functions}
        for pattern in question.patterns:
            if pattern.products not in known:
                known[pattern.products] = start + np.arange(
                    sum(len(product.terms) for product in pattern.products)
                )
                products += pattern.products
                start += len(known[pattern.products])
            of_question.append(
                replace(
                    of_question[0],
                    functions=known[pattern.products],
                    combination=pattern.combination,
                    is_pattern=True,
                )
            )
        regressors += of_question
        if question.adjusted_for:
            adjustment = np.concatenate([none, *groups.get(question.adjusted_for, [])])
            regressors += [replace(tested, adjusted_for=adjustment) for tested in of_question]
    return TestedFunctions(sample, tuple(products), tuple(regressors))


def _along_axes(several: Iterable[Products], n_detections: int) -> tuple[list[Products], Float]:
    """Products without directions, and the combinations (2 f, q) that restore given directions."""
    parts: list[Products] = []
    blocks: list[Float] = []
    for product in several:
        n = len(product.terms)
        if product.direction is None:
            parts.append(product)
            blocks.append(np.eye(2 * n))
            continue
        values = np.ones(n_detections) if product.values is None else product.values
        parts += [Products(product.terms, values * along) for along in product.direction]
        blocks.append(np.concatenate([np.kron(np.eye(n), axis[:, None]) for axis in np.eye(2)]))
    return parts, np.asarray(block_diag(*blocks))


def _rising_from_edges() -> Iterator[Float]:
    """Iterate over displacements along one axis that rise in proportion to the distance on it.

    The distance is that from the first or the last column for displacements along x, and from the
    first or the last row for those along y.  They are combinations (6, 1) of both axes of `LINEAR`.
    """
    constant = LINEAR.index((0, 0))
    for axis, term in enumerate(((1, 0), (0, 1))):
        for sign in (1.0, -1.0):
            combination = np.zeros((2 * len(LINEAR), 1))
            combination[2 * constant + axis] = 1.0
            combination[2 * LINEAR.index(term) + axis] = sign
            yield combination


def _outwards() -> Iterator[Float]:
    """Iterate over displacements away from the middle of the chip, at all edges and at each alone.

    They are combinations (8, 1) of both axes of the functions that rise towards the first and the
    last column, and the first and the last row.
    """
    each = np.zeros((4, 8, 1))
    for k, sign in enumerate((-1.0, 1.0, -1.0, 1.0)):
        each[k, 2 * k + k // 2] = sign
    yield each.sum(axis=0)
    yield from each


def one_of_each(found: Iterable[tuple[Regressors, Outcome]]) -> list[Outcome]:
    """Outcomes with one test per question.

    The p-values of single patterns are combined with that of the test of all directions.  If the
    adjusted test is insignificant, its result is used: adjusting for other functions reduces the
    power of a test but does not remove a real effect.
    """
    # by name, and whether other functions are adjusted for
    of_all: dict[tuple[str, bool], Outcome] = {}
    patterns: dict[tuple[str, bool], list[float]] = {}
    for several, result in found:
        key = result.name, len(several.adjusted_for) > 0
        if several.is_pattern:
            patterns.setdefault(key, []).append(result.p_value)
        else:
            of_all[key] = result
    for key, p_values in patterns.items():
        if key in of_all:
            of_all[key] = _with_patterns(of_all[key], p_values)
    out = {name: result for (name, adjusted), result in of_all.items() if not adjusted}
    for (name, adjusted), result in of_all.items():
        if adjusted and name in out and result.p_value > SAYS_NOTHING:
            out[name] = result
    return list(out.values())


def _with_patterns(tested: Outcome, p_values: Sequence[float]) -> Outcome:
    """Outcome of the test of all directions, combined with the p-values of single patterns.

    The statistic is the one that has the combined p-value, and the smallest size that of an effect
    in any direction.
    """
    n = len(p_values)
    weights = [WEIGHT_OF_ALL, *[(1 - WEIGHT_OF_ALL) / n] * n]
    p_value = combined_p([tested.p_value, *p_values], weights)
    return replace(
        tested,
        statistic=_statistic_of(p_value, tested.dof, tested.dof_residual),
        p_value=p_value,
        smallest=partial(_smallest_of_any, tested),
    )


def _smallest_of_any(tested: Outcome, level: float) -> float:
    """Size that the test of all directions finds alone, with its weight."""
    return tested.smallest(WEIGHT_OF_ALL * level)


def _statistic_of(p_value: float, dof: float, dof_residual: float | None) -> float:
    """Statistic of `dof` directions with this p-value."""
    p_value = max(p_value, MIN_P)
    if dof_residual is None:
        return float(chi2_isf(p_value, dof))
    return float(dof * f_isf(p_value, dof, dof_residual))
