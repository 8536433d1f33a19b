"""Columns by which a self-calibration is asked for what its model lacks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bayesdist.diagnose.correlated.functions import legendre_products
from bayesdist.diagnose.selfcal.eliminated import Columns
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.model.basis import polynomial_terms

__all__ = ["AddedColumns", "pointing_terms"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

HIGHER = 2  # orders above the model's that are tested
LINEAR = polynomial_terms(1)
UNDITHERED = 1e-3  # of half a side: offsets that say nothing


@dataclass(frozen=True, eq=False)
class AddedColumns(Columns):
    """Terms that the model lacks, on both axes of every chip, and deviations of exposures.

    They are terms of higher order, linear terms times the magnitude, and quadratic terms of the
    position times the offset of the exposure.
    """

    mag: Float | None = field(default=None)  # (N,) of each detection, about the mean
    pointed: Float | None = field(default=None)  # (N, 6) as of `pointing_terms`

    @cached_property
    def terms(self) -> tuple[tuple[int, int], ...]:
        """Powers of the terms of higher order."""
        order = self.problem.model.order
        return polynomial_terms(order + HIGHER)[len(polynomial_terms(order)) :]

    @cached_property
    def counts(self) -> dict[str, int]:
        """Number of terms of each kind along one axis, in their order."""
        return {
            "order": len(self.terms),
            "magnitude": 0 if self.mag is None else len(LINEAR),
            "pointing": 0 if self.pointed is None else self.pointed.shape[1],
        }

    def n_functions(self, chip: int) -> int:
        """Number of functions along one axis."""
        return sum(self.counts.values())

    def values(self, chip: int, rows: Int) -> Float:
        """Values (n, n_functions) of these."""
        X, Y = self.problem.X[rows], self.problem.Y[rows]
        out = [legendre_products(X, Y, self.terms)]
        if self.mag is not None:
            out.append(self.mag[rows, None] * legendre_products(X, Y, LINEAR))
        if self.pointed is not None:
            out.append(self.pointed[rows])
        return np.concatenate(out, axis=1)

    def families(self) -> Iterator[tuple[str, Int]]:
        """Name of each test, and which of the further columns it has."""
        n, order = self.n_functions(0), self.problem.model.order
        start = n * np.arange(2 * len(self.problem.model.chips))[:, None]
        degree = np.array([sum(term) for term in self.terms])
        for step in range(1, HIGHER + 1):
            yield f"order {order + step}", np.ravel(start + np.flatnonzero(degree == order + step))
        first = 0
        for name, count in self.counts.items():
            if count and name != "order":
                yield name, np.ravel(start + np.arange(first, first + count))
            first += count
        if self.deviations is not None:
            first = n * len(start)
            yield "exposures", first + np.arange(self.deviations.n_of_exposures)


def pointing_terms(problem: Problem, theta: Float) -> Float | None:
    """Quadratic terms (N, 6) of the position times the offset, along the axes of the detector.

    To their first order these are what a curved sky makes of the tangent planes of exposures.

    Lengths are in half sides of the detector; None where nothing was dithered.
    """
    model = problem.model
    exposure = problem.groups.exposure[problem.groups.index]
    half = model.pixel_size(theta) * max(max(c.size) for c in model.chips) / 2
    on_sky = problem.places(theta) - np.asarray(model.origin)
    offsets, positions = np.zeros((len(problem), 2)), np.empty((len(problem), 2))
    for e in np.unique(exposure):
        here = exposure == e
        M, shift = model.frame(theta, int(e))
        back = np.linalg.inv(M).T / half
        offsets[here] = shift @ back
        positions[here] = (on_sky[here] - shift) @ back
    offsets -= offsets.mean(axis=0)  # of a mean the polynomials take care
    if np.abs(offsets).max() < UNDITHERED:
        return None
    p, q = positions.T
    squares = np.stack([p * p, p * q, q * q], axis=1)
    return np.reshape(squares[:, :, None] * offsets[:, None, :], (len(problem), -1))
