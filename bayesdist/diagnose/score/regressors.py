"""Functions of the detections by which questions are asked, one after the other, with indices."""

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

CONSTANT = 1e-9  # scatter of values, in magnitudes or of the time from -1 to 1
SAYS_NOTHING = 0.2  # probability by chance above which an adjusted test has seen nothing


@dataclass(frozen=True, eq=False)
class Regressors:
    """Directions that one test adds to the model on every chip: functions along its axes."""

    family: Family
    functions: Int  # (f,) which `Functions`
    # (2 f, q) of each direction: along both axes of the first function, of the second, ...
    combination: Float
    least: float  # as of `Question`
    # functions that the fit is given as well, so that they do not pass for these
    adjusted_for: Int

    @property
    def every(self) -> Int:
        """Indices of all of these functions, the tested ones first."""
        return np.concatenate([self.functions, self.adjusted_for])

    def own(self, n_chips: int) -> Bool:
        """Boolean mask of what is tested, along both axes of every function on some chips."""
        mask = np.arange(len(self.every)) < len(self.functions)
        return np.tile(np.repeat(mask, 2), n_chips)

    def directions(self, n_chips: int) -> Float:
        """Combinations of what is tested on some chips, each with a coefficient of its own."""
        return np.asarray(np.kron(np.eye(n_chips), self.combination), float)


@dataclass(frozen=True, eq=False)
class Functions:
    """Functions of the detections: those of the model, and those that the tests add."""

    sample: ScoredSample
    products: tuple[Products, ...]  # without directions; the first are the model's own
    regressors: tuple[Regressors, ...]

    @cached_property
    def terms(self) -> tuple[tuple[int, int], ...]:
        """Powers (i, j) of every function."""
        return tuple(term for one in self.products for term in one.terms)

    @property
    def n_added(self) -> int:
        """Number of functions that the tests add to those of the model."""
        return len(self.terms) - self.sample.model.n_terms

    @property
    def mean_square(self) -> Float:
        """Mean square of every function (L,) over the detector, and over the detections."""
        i, j = np.array(self.terms).T
        sizes = [
            np.full(len(one.terms), 1.0 if one.values is None else np.mean(one.values**2))
            for one in self.products
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
        """Powers of the distinct terms, those of the model first, and which each product has."""
        index = {term: k for k, term in enumerate(dict.fromkeys(self.terms))}
        i, j = np.array(list(index), np.int64).T
        return i, j, [np.array([index[term] for term in one.terms]) for one in self.products]

    def polynomials(self, rows: slice) -> Float:
        """Values (K, n) of the model's own functions at some detections."""
        K = self.sample.model.n_terms
        P, Q = self._tables
        i, j, _ = self._distinct
        return np.asarray(P[i[:K], rows] * Q[j[:K], rows])

    def at(self, rows: slice | Int) -> Float:
        """Values (L, n) of all functions at some detections."""
        i, j, which = self._distinct
        P, Q = (table[:, rows] for table in self._tables)
        distinct = P[i] * Q[j]
        return np.concatenate(
            [
                distinct[terms] if one.values is None else distinct[terms] * one.values[rows]
                for one, terms in zip(self.products, which, strict=True)
            ]
        )


def functions_for(sample: ScoredSample, asked: Iterable[Question] | None = None) -> Functions:
    """Functions of the questions, by default of all that a sample can be asked."""
    products = [Products(polynomial_terms(sample.model.order))]
    start = len(products[0].terms)
    regressors: list[Regressors] = []
    groups: dict[str, list[Int]] = {}
    for one in questions(sample) if asked is None else asked:
        if all(p.values is not None and np.std(p.values) < CONSTANT for p in one.products):
            continue
        parts, combination = _along_axes(one.products, len(sample))
        functions = start + np.arange(sum(len(part.terms) for part in parts))
        products += parts
        start += len(functions)
        groups.setdefault(one.family.group, []).append(functions)
        none = np.zeros(0, np.int64)
        regressors.append(Regressors(one.family, functions, combination, one.least, none))
        if one.adjusted_for:
            others = np.concatenate([none, *groups.get(one.adjusted_for, [])])
            regressors.append(Regressors(one.family, functions, combination, one.least, others))
    return Functions(sample, tuple(products), tuple(regressors))


def _along_axes(several: Iterable[Products], n_detections: int) -> tuple[list[Products], Float]:
    """Products without directions, and how those with directions are combined (2 f, q) of them."""
    parts: list[Products] = []
    blocks: list[Float] = []
    for one in several:
        n = len(one.terms)
        if one.direction is None:
            parts.append(one)
            blocks.append(np.eye(2 * n))
            continue
        values = np.ones(n_detections) if one.values is None else one.values
        for along in one.direction:
            parts.append(Products(one.terms, values * along))
        blocks.append(np.concatenate([np.kron(np.eye(n), axis[:, None]) for axis in np.eye(2)]))
    return parts, np.asarray(block_diag(*blocks))


def one_of_each(found: Iterable[tuple[Regressors, Outcome]]) -> list[Outcome]:
    """Outcomes with one test of each question: the adjusted one, where that says nothing.

    Adjusted for others there is less to be seen of what is there by itself, but something.
    """
    pairs = [(len(several.adjusted_for) > 0, one) for several, one in found]
    out = {one.name: one for adjusted, one in pairs if not adjusted}
    for adjusted, one in pairs:
        if adjusted and one.name in out and one.p_value > SAYS_NOTHING:
            out[one.name] = one
    return list(out.values())
