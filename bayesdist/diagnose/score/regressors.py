"""Functions of the detections that the score tests add to the model, with their indices."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import legendre
from scipy.linalg import block_diag

from bayesdist.diagnose.score.questions import Products, Question, questions
from bayesdist.diagnose.score.result import Family, Outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.model.basis import polynomial_terms
from bayesdist.utils.arrays import Bool, Float, Int

# smallest standard deviation of values, in magnitudes or in units of half the time span
CONSTANT = 1e-9
SAYS_NOTHING = 0.2  # p-value above which an adjusted test counts as insignificant


@dataclass(frozen=True, eq=False)
class Regressors:
    """Directions that one test adds to the model on every chip: functions along its axes."""

    family: Family
    functions: Int  # (f,) indices into the functions of `Functions`
    # (2 f, q) components of each direction: both axes of the first function, of the second, ...
    combination: Float
    least: float  # see `Question`
    # indices of functions that are fitted as well, so that they are not mistaken for the tested
    # ones
    adjusted_for: Int

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
class Functions:
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


def functions_for(sample: ScoredSample, asked: Iterable[Question] | None = None) -> Functions:
    """Functions for the questions `asked`; by default for all that the sample can answer."""
    products = [Products(polynomial_terms(sample.model.order))]
    start = len(products[0].terms)
    regressors: list[Regressors] = []
    groups: dict[str, list[Int]] = {}
    for question in questions(sample) if asked is None else asked:
        if all(p.values is not None and np.std(p.values) < CONSTANT for p in question.products):
            continue
        parts, combination = _along_axes(question.products, len(sample))
        functions = start + np.arange(sum(len(part.terms) for part in parts))
        products += parts
        start += len(functions)
        groups.setdefault(question.family.group, []).append(functions)
        none = np.zeros(0, np.int64)
        regressors.append(Regressors(question.family, functions, combination, question.least, none))
        if question.adjusted_for:
            adjustment = np.concatenate([none, *groups.get(question.adjusted_for, [])])
            regressors.append(
                Regressors(question.family, functions, combination, question.least, adjustment)
            )
    return Functions(sample, tuple(products), tuple(regressors))


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
        for along in product.direction:
            parts.append(Products(product.terms, values * along))
        blocks.append(np.concatenate([np.kron(np.eye(n), axis[:, None]) for axis in np.eye(2)]))
    return parts, np.asarray(block_diag(*blocks))


def one_of_each(found: Iterable[tuple[Regressors, Outcome]]) -> list[Outcome]:
    """Outcomes with one test per question: the adjusted test if it is insignificant.

    Adjusting for other functions reduces the power of a test but does not remove a real effect.
    """
    pairs = [(len(several.adjusted_for) > 0, result) for several, result in found]
    out = {result.name: result for adjusted, result in pairs if not adjusted}
    for adjusted, result in pairs:
        if adjusted and result.name in out and result.p_value > SAYS_NOTHING:
            out[result.name] = result
    return list(out.values())
