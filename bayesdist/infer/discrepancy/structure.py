"""Posterior of what a polynomial leaves out on one axis of one chip, amplitudes marginalised.

With what the fit has taken eliminated, the data speak of the coefficients z of the structure's
functions through a score s and an information S, so that for amplitudes eta

    z | eta   ~ N((S + P)^-1 s, (S + P)^-1)             P = P(eta), the prior precision
    log p(eta | data) = log p(eta) + (s^T (S + P)^-1 s - log|S + P| + log|P|) / 2

The amplitude and the correlation length of the Matern field and the amplitude of the higher orders
are gone through on a grid that is refined where the density is.  What the field has at frequencies
above the functions' is seen in pairs of stars (`SharedVariance`), whose likelihood is a factor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from bayesdist.infer.discrepancy.functions import FINE, StructureFunctions
from bayesdist.infer.discrepancy.neighbours import SharedVariance
from bayesdist.infer.discrepancy.priors import log_half_cauchy

__all__ = ["AxisStructure", "axis_structure"]

Float = NDArray[np.float64]

LENGTHS = np.geomspace(0.02, 0.6, 7)  # of the field, in longer half sides; all alike beforehand
STEPS = 8  # of the amplitude, before the grid is refined
HALVINGS = 6  # at most: neighbouring stars may say an amplitude to some percent
NEGLIGIBLE = 9.0  # in log density, below the largest
SMOOTH = 0.7  # in log density, from one point of the grid to the next
TERM_STEPS = 24  # of the amplitude of the higher orders


@dataclass(frozen=True, eq=False)
class _Point:
    """One length and amplitude of the field, and what follows for all amplitudes of the terms."""

    length: float
    amplitude: float
    factor: Float  # lower Cholesky factor of the sines' precision
    right: Float  # that factor's inverse times the sines' score
    tied: Float  # and times what ties them to the terms
    values: Float  # eigenvalues of the terms' information without the sines
    vectors: Float
    score: Float  # of the terms, along these
    log_density: Float  # (TERM_STEPS,), by amplitude of the terms


@dataclass(frozen=True, eq=False)
class AxisStructure:
    """Posterior of the structure on one axis of a chip.

    Parameters
    ----------
    functions : StructureFunctions
    terms_amplitude : ndarray, shape (TERM_STEPS,)
        Amplitudes of the higher orders that are gone through.
    points : tuple
        Lengths and amplitudes of the field.
    weight : ndarray, shape (points, TERM_STEPS)
        Posterior probability of each combination.
    """

    functions: StructureFunctions
    terms_amplitude: Float
    points: tuple[_Point, ...]
    weight: Float

    def draws(self, n: int, rng: np.random.Generator) -> Float:
        """Coefficients (n, n_known + 2 FINE) of terms, sines and finer waves."""
        functions, T = self.functions, self.functions.n_terms
        decline = functions.decline()
        counts = rng.multinomial(n, self.weight.ravel()).reshape(self.weight.shape)
        out = []
        for point, by_terms in zip(self.points, counts, strict=True):
            m = int(by_terms.sum())
            if not m:
                continue
            amplitude = np.repeat(self.terms_amplitude, by_terms)
            precision = point.values + amplitude[:, None] ** -2
            along = point.score / precision
            along = along + rng.standard_normal((m, T)) / np.sqrt(precision)
            terms = along @ point.vectors.T
            right = point.right[:, None] - point.tied @ terms.T
            right += rng.standard_normal(right.shape)
            sines = _solve(point.factor, right, trans=1).T
            fine = point.amplitude * np.sqrt(functions.finer(point.length))
            waves = fine * rng.standard_normal((m, 2 * FINE))
            out.append(np.concatenate([terms * decline, sines, waves], axis=1))
        return rng.permutation(np.concatenate(out))

    @property
    def field_rms(self) -> float:
        """Root of the mean posterior square of the field's amplitude."""
        by_point = self.weight.sum(axis=1)
        return float(np.sqrt(by_point @ [p.amplitude**2 for p in self.points]))

    @property
    def length(self) -> float:
        """Posterior mean correlation length of the field, weighed by variance, in half sides."""
        by_point = self.weight.sum(axis=1) * [p.amplitude**2 for p in self.points]
        return float(by_point @ [p.length for p in self.points] / by_point.sum())


def axis_structure(
    functions: StructureFunctions,
    information: Float,
    score: Float,
    *,
    noise: float,
    higher_order: float,
    structure: float,
    pairs: SharedVariance | None = None,
) -> AxisStructure:
    """Posterior of the coefficients of structure functions on one axis.

    Parameters
    ----------
    functions : StructureFunctions
    information : ndarray, shape (n_known, n_known)
        Of their coefficients, with what the fit takes eliminated.
    score : ndarray, shape (n_known,)
        Gradient of the log-likelihood where they are zero, in the same way.
    noise : float
        Typical error of one star: no amplitude beyond a few of it is looked at.
    higher_order, structure : float
        Prior medians of the amplitudes, in the unit of the positions.
    pairs : SharedVariance, optional
        What neighbouring stars say of the field at frequencies above those of the functions.

    Returns
    -------
    AxisStructure
    """
    T = functions.n_terms
    scale = functions.decline()
    tied = information[T:, :T] * scale
    terms = (information[:T, :T] * np.outer(scale, scale), score[:T] * scale)
    resolved = 1 / np.sqrt(max(float(np.median(np.diag(information)[:T])), 1e-300))
    low = 0.2 * min(higher_order, structure, resolved)
    high = max(3 * noise, 10 * structure)
    amplitudes = np.geomspace(low, 3 * high, TERM_STEPS)
    prior = log_half_cauchy(amplitudes, higher_order)

    def at(length: float, log_amplitude: float) -> _Point:
        amplitude = float(np.exp(log_amplitude))
        variance = amplitude**2 * functions.spectrum(length)
        matrix = information[T:, T:] + np.diag(1 / variance)
        factor = scipy.linalg.cholesky(matrix, lower=True, check_finite=False)
        solved = _solve(factor, np.column_stack([score[T:], tied]))
        right, through = solved[:, 0], solved[:, 1:]
        values, vectors = np.linalg.eigh(terms[0] - through.T @ through)
        values = np.maximum(values, 0.0)
        left = vectors.T @ (terms[1] - through.T @ right)
        evidence = 0.5 * right @ right - np.log(np.diag(factor)).sum()
        evidence -= 0.5 * np.log(variance).sum()
        by_terms = 0.5 * (left**2 / (values + amplitudes[:, None] ** -2)).sum(axis=1)
        by_terms -= 0.5 * np.log1p(values * amplitudes[:, None] ** 2).sum(axis=1)
        density = by_terms + prior + evidence + log_half_cauchy(np.array(amplitude), structure)
        if pairs is not None:
            density = density + pairs.log_density(amplitude, shared[length])
        return _Point(length, amplitude, factor, right, through, values, vectors, left, density)

    shared = {} if pairs is None else {a: pairs.correlation(functions, a) for a in LENGTHS}
    found: list[tuple[_Point, float]] = []
    for length in LENGTHS:
        grid = list(np.linspace(np.log(low), np.log(high), STEPS))
        points = [at(length, a) for a in grid]
        for _ in range(HALVINGS):
            tops = [p.log_density.max() for p in points]
            best = max([*tops, *(p.log_density.max() for p, _ in found)])
            n = len(grid)
            grid, points = _refined(grid, points, tops, best - NEGLIGIBLE, length, at)
            if len(grid) == n:
                break
        widths = np.gradient(grid)
        found += [
            (p, w)
            for p, w in zip(points, widths, strict=True)
            if p.log_density.max() > best - NEGLIGIBLE
        ]
    log_weight = np.array([p.log_density + np.log(w) for p, w in found])
    weight = np.exp(log_weight - log_weight.max())
    return AxisStructure(functions, amplitudes, tuple(p for p, _ in found), weight / weight.sum())


def _refined(grid, points, tops, least, length, at):  # type: ignore[no-untyped-def]
    """The grid with a point in the middle of each interval that has some of the density."""
    new_grid, new_points = grid[:1], points[:1]
    for k in range(1, len(grid)):
        if max(tops[k - 1], tops[k]) > least and abs(tops[k] - tops[k - 1]) > SMOOTH:
            middle = 0.5 * (grid[k - 1] + grid[k])
            new_grid.append(middle)
            new_points.append(at(length, middle))
        new_grid.append(grid[k])
        new_points.append(points[k])
    return new_grid, new_points


def _solve(factor: Float, right: Float, trans: int = 0) -> Float:
    return np.asarray(
        scipy.linalg.solve_triangular(factor, right, trans=trans, lower=True, check_finite=False)
    )
