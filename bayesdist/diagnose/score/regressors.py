"""Functions of the stars that a model may lack.

They are terms of higher order, and terms that go with magnitude, colour and time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from bayesdist.diagnose.score.families import FAMILIES, Family, order_family
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.model.basis import polynomial_terms
from bayesdist.model.timedep import TimeDependence

__all__ = ["EDGES", "EDGES_ADJUSTED", "Factor", "Functions", "Regressors", "functions_for"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

EDGES, EDGES_ADJUSTED = "edges", "edges adjusted for orders"
LINEAR = 1  # order of the terms that go with magnitude, colour and time
HIGHER = 2  # orders above the model's that are tested
OUTSIDE = 0.5  # per cent of the values at either end that are moved to the others
MIN_AT_EDGES = 200  # detections: some in each margin
NEAR_EDGE = 0.05  # of half a side, over which what is at an edge falls off
SHORTEST = 0.1  # years over which a drift is looked for
# of the information of a direction, left by the parameters: below, it is theirs
INDEPENDENT = 1e-6
CONSTANT = 1e-9  # scatter of a factor, in magnitudes or of the time from -1 to 1
OWN_OF_TIME = 0.02  # frames take up drifts but for what the curvature of the polynomial leaves


@dataclass(frozen=True, eq=False)
class Factor:
    """Number of each detection that multiplies polynomial terms."""

    values: Float  # (N,)
    order: int  # of the terms, 0 included

    @property
    def n_terms(self) -> int:
        """Number of products."""
        return len(polynomial_terms(self.order))


@dataclass(frozen=True, eq=False)
class Regressors:
    """Functions that one test adds to the model, on both axes of every chip."""

    family: Family
    functions: Int  # which `Functions`
    # fraction of its information that a direction must keep when parameters are projected out
    least: float = INDEPENDENT
    # functions that the fit is given as well, so that they do not pass for these
    adjusted_for: Int = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def every(self) -> Int:
        """Indices of all of these functions, the tested ones first."""
        return np.concatenate([self.functions, self.adjusted_for])

    @property
    def own(self) -> NDArray[np.bool_]:
        """Boolean mask of those that are tested."""
        return np.arange(len(self.functions) + len(self.adjusted_for)) < len(self.functions)


@dataclass(frozen=True, eq=False)
class Functions:
    """Functions of the detections: those of the model, and those that the tests add."""

    sample: ScoredSample
    order: int  # highest total order of the polynomials
    factors: tuple[Factor, ...]
    regressors: tuple[Regressors, ...]

    @cached_property
    def terms(self) -> tuple[tuple[int, int], ...]:
        """Powers (i, j) of every function, by the polynomial and then by the factors."""
        out = list(polynomial_terms(self.order))
        for factor in self.factors:
            out += polynomial_terms(factor.order)
        return tuple(out)

    @property
    def mean_square(self) -> Float:
        """Mean square of every function (L,) over the detector, and over the detections."""
        i, j = np.array(self.terms).T
        sizes = [np.ones(len(polynomial_terms(self.order)))]
        sizes += [np.full(one.n_terms, np.mean(one.values**2)) for one in self.factors]
        return np.concatenate(sizes) / ((2 * i + 1) * (2 * j + 1))

    @cached_property
    def _tables(self) -> tuple[Float, Float]:
        """Legendre polynomials (order + 1, N) of both coordinates."""
        X, Y = self.sample.X, self.sample.Y
        P, Q = (np.asarray(legendre.legvander(z, self.order).T, float) for z in (X, Y))
        return P, Q

    @cached_property
    def _powers(self) -> tuple[Int, Int]:
        i, j = np.array(polynomial_terms(self.order), np.int64).T
        return i, j

    def polynomials(self, rows: slice) -> Float:
        """Values (K, n) of the model's own functions at some detections."""
        K = self.sample.model.n_terms
        P, Q = self._tables
        i, j = self._powers
        return np.asarray(P[i[:K], rows] * Q[j[:K], rows])

    def at(self, rows: slice) -> Float:
        """Values (L, n) of all functions at some detections."""
        P, Q = self._tables
        i, j = self._powers
        products = P[i, rows] * Q[j, rows]
        parts = [products]
        parts += [products[: one.n_terms] * one.values[rows] for one in self.factors]
        return np.concatenate(parts)


def functions_for(sample: ScoredSample) -> Functions:
    """Functions that the data can be asked for."""
    n = sample.model.order
    regressors = [
        Regressors(order_family(total, n), len(polynomial_terms(total - 1)) + np.arange(total + 1))
        for total in range(n + 1, n + HIGHER + 1)
    ]
    orders = np.concatenate([one.functions for one in regressors])
    factors: list[Factor] = []
    start = len(polynomial_terms(n + HIGHER))
    for name, several, least in _questions(sample):
        if all(np.std(one.values) < CONSTANT for one in several):
            continue
        functions = start + np.arange(sum(one.n_terms for one in several))
        factors += several
        start += len(functions)
        regressors.append(Regressors(FAMILIES[name], functions, least))
        if name == EDGES:
            adjusted = replace(FAMILIES[EDGES], name=EDGES_ADJUSTED)
            regressors.append(Regressors(adjusted, functions, least, orders))
    return Functions(sample, n + HIGHER, tuple(factors), tuple(regressors))


def _questions(sample: ScoredSample) -> Iterator[tuple[str, list[Factor], float]]:
    """Iterator over tests by name: factors of their functions, and what a direction must keep."""
    for name, values in (("magnitude", sample.mag), ("colour", sample.colour)):
        if values is not None:
            yield name, [Factor(_standing_out(values), LINEAR)], INDEPENDENT
    if len(sample) >= MIN_AT_EDGES:
        edges = [np.exp((s * Z - 1.0) / NEAR_EDGE) for Z in (sample.X, sample.Y) for s in (-1, 1)]
        yield EDGES, [Factor(one - one.mean(), 0) for one in edges], INDEPENDENT
    time, epoch = sample.model.time, sample.epoch
    if epoch is None or np.ptp(epoch) <= SHORTEST:
        return
    half = (2 * epoch - epoch.min() - epoch.max()) / np.ptp(epoch)  # from -1 to 1
    if sample.mag is not None:
        values = _standing_out(sample.mag) * half
        yield "magnitude in time", [Factor(values, LINEAR)], INDEPENDENT
    yield "drift", [Factor(half - half.mean(), LINEAR)], OWN_OF_TIME
    if time is not None and len(np.unique(epoch)) > 2:
        order = max([LINEAR, *(i + j for _, i, j in time.terms)])
        factor = Factor(_beyond_lines(half, time, epoch), order)
        yield "curvature in time", [factor], OWN_OF_TIME


def _standing_out(values: Float) -> Float:
    """Values about their mean; codes for what is missing are brought to the others."""
    low, high = np.percentile(values, [OUTSIDE, 100 - OUTSIDE])
    inside = np.clip(values, low, high)
    return np.asarray(inside - inside.mean())


def _beyond_lines(half: Float, time: TimeDependence, epoch: Float) -> Float:
    """Square of time, without what a constant and the segments' own lines say of it."""
    design = np.column_stack([np.ones(len(half)), time.weights(epoch)])
    dates, of = np.unique(half, return_inverse=True)
    first = np.unique(of, return_index=True)[1]
    weight = np.sqrt(np.bincount(of))
    found = np.linalg.lstsq(weight[:, None] * design[first], weight * dates**2)[0]
    return half**2 - design @ found
