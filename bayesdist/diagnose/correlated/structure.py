"""Posterior of the structure outside a polynomial on a chip, amplitudes marginalised.

With the part that the fit absorbs eliminated, the data determine the coefficients z of the
structure's functions through a score s and an information S, so that for amplitudes eta

    z | eta   ~ N((S + P)^-1 s, (S + P)^-1)             P = P(eta), the prior precision
    log p(eta | data) = log p(eta) + (s^T (S + P)^-1 s - log|S + P| + log|P|) / 2

The amplitude and the correlation length of the Matern field and the amplitude of the higher orders
are integrated on a grid that is refined where the density is.  Structure too fine for the functions
shows in neighbouring stars (`SharedVariance`), whose likelihood is a factor.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from bayesdist.diagnose.correlated.functions import FINE, StructureFunctions
from bayesdist.diagnose.correlated.neighbours import SharedVariance
from bayesdist.diagnose.correlated.priors import AmplitudeGrid, log_half_cauchy, log_widths

__all__ = ["Structure", "chip_structure"]

Float = NDArray[np.float64]

# of the field, in longer half sides; all equally probable beforehand
LENGTHS = np.geomspace(0.02, 0.6, 7)
STEPS = 8  # of the amplitude, before the grid is refined
HALVINGS = 6  # at most: neighbouring stars may determine an amplitude to some percent
CHANGE = 0.7  # of the log density between two points, below which none is inserted between them,
WIDEST = 0.4  # or width of their interval in the logarithm, where most of the density is
NEGLIGIBLE = 10.0  # in log density, below the largest
NEAR_TOP = 2.0  # likewise, for most of the density
UNLIKE = 0.2  # prior probability that the field differs on the two axes, by about a factor e


@dataclass(frozen=True, eq=False)
class _Axis:
    """Likelihood along one axis, given length and amplitude of the field."""

    factor: Float  # lower Cholesky factor of the sines' precision
    right: Float  # its inverse times the sines' score
    tied: Float  # its inverse times the coupling of the sines to the terms
    values: Float  # eigenvalues of the terms' information without the sines
    vectors: Float  # eigenvectors of the same
    score: Float  # of the terms, along these

    def log_evidence(self, amplitudes: Float) -> Float:
        """Log evidence by the amplitude of the terms, without the part of the sines' spectrum."""
        out = 0.5 * self.right @ self.right - np.log(np.diag(self.factor)).sum()
        out += 0.5 * (self.score**2 / (self.values + amplitudes[:, None] ** -2)).sum(axis=1)
        return np.asarray(out - 0.5 * np.log1p(self.values * amplitudes[:, None] ** 2).sum(axis=1))

    def draws(self, amplitude: Float, rng: np.random.Generator) -> tuple[Float, Float]:
        """Terms (m, T) and sines (m, n_sines), given amplitudes (m,) of the terms."""
        precision = self.values + amplitude[:, None] ** -2
        # noise through the symmetric root, which signs and order of eigenvectors do not change
        noise = rng.standard_normal((len(precision), len(self.values))) @ self.vectors
        terms = (self.score / precision + noise / np.sqrt(precision)) @ self.vectors.T
        right = self.right[:, None] - self.tied @ terms.T
        right += rng.standard_normal(right.shape)
        return terms, _solve(self.factor, right, trans=1).T


@dataclass(frozen=True, eq=False)
class _Point:
    """A correlation length, and an amplitude of the field on each axis."""

    length: float
    amplitudes: tuple[float, float]
    axes: tuple[_Axis, _Axis]


@dataclass(frozen=True, eq=False)
class Structure:
    """Posterior of the structure on a chip."""

    functions: StructureFunctions
    terms_amplitude: Float  # grid (TERM_STEPS,) of amplitudes of the higher orders
    points: tuple[_Point, ...]  # lengths and amplitudes of the field
    weight: Float  # posterior probability (points, TERM_STEPS) of each combination

    def draws(self, n: int, rng: np.random.Generator) -> Float:
        """Coefficients (n, 2, n_known + 2 FINE) of terms, sines and finer waves on both axes."""
        functions, decline = self.functions, self.functions.decline()
        counts = rng.multinomial(n, self.weight.ravel()).reshape(self.weight.shape)
        out = []
        for point, by_terms in zip(self.points, counts, strict=True):
            m = int(by_terms.sum())
            if not m:
                continue
            amplitude = np.repeat(self.terms_amplitude, by_terms)
            fine = np.sqrt(functions.finer(point.length))
            both = []
            for size, axis in zip(point.amplitudes, point.axes, strict=True):
                terms, sines = axis.draws(amplitude, rng)
                waves = size * fine * rng.standard_normal((m, 2 * FINE))
                both.append(np.concatenate([terms * decline, sines, waves], axis=1))
            out.append(np.stack(both, axis=1))
        return rng.permutation(np.concatenate(out))

    @property
    def length(self) -> float:
        """Posterior mean correlation length of the field, weighted by variance, in half sides."""
        by_point = self.weight.sum(axis=1)
        by_point = by_point * [np.square(p.amplitudes).sum() for p in self.points]
        return float(by_point @ [p.length for p in self.points] / by_point.sum())


def chip_structure(
    functions: StructureFunctions,
    information: Sequence[Float],
    score: Sequence[Float],
    *,
    noise: float,
    higher_order: float,
    structure: float,
    pairs: Sequence[SharedVariance | None] = (None, None),
) -> Structure:
    """Posterior of the coefficients of structure functions on the two axes of a chip.

    Length and amplitudes are those of both axes: what bends light or silicon bends it along both,
    and few data determine little of each.  But the field may differ, as a pattern of columns does.

    For each axis `information` (n_known, n_known) is that of the coefficients, and `score`
    (n_known,) the gradient of the log-likelihood where they are zero, both with the part that the
    fit absorbs eliminated; `pairs` is the evidence of neighbouring stars.  `noise` is the typical
    error of one star, a few times which limits the amplitudes; `higher_order` and `structure` are
    prior medians of the amplitudes, in the unit of the positions.
    """
    T = functions.n_terms
    scale = functions.decline()
    best_known = max((np.diag(S)[:T] for S in information), key=np.median)
    amplitudes = AmplitudeGrid.of(
        best_known, noise=noise, higher_order=higher_order, structure=structure
    )
    prior = amplitudes.log_prior

    def axis_at(S: Float, s: Float, variance: Float) -> _Axis:
        matrix = S[T:, T:] + np.diag(1 / variance)
        factor = scipy.linalg.cholesky(matrix, lower=True, check_finite=False)
        solved = _solve(factor, np.column_stack([s[T:], S[T:, :T] * scale]))
        right, tied = solved[:, 0], solved[:, 1:]
        values, vectors = np.linalg.eigh(S[:T, :T] * np.outer(scale, scale) - tied.T @ tied)
        along = vectors.T @ (s[:T] * scale - tied.T @ right)
        return _Axis(factor, right, tied, np.maximum(values, 0.0), vectors, along)

    def at(length: float, log_amplitude: float) -> _Sized:
        amplitude = float(np.exp(log_amplitude))
        variance = amplitude**2 * functions.spectrum(length)
        axes, evidence = [], []
        for S, s, known in zip(information, score, shared[length], strict=True):
            axes.append(axis_at(S, s, variance))
            found = axes[-1].log_evidence(amplitudes.terms) - 0.5 * np.log(variance).sum()
            evidence.append(found if known is None else found + known(amplitude))
        return _Sized(amplitude, (axes[0], axes[1]), np.stack(evidence))

    shared = {
        length: [None if p is None else p.of_field(length) for p in pairs] for length in LENGTHS
    }
    points, log_weight = list[_Point](), list[Float]()
    for length in LENGTHS:
        grid = list(np.linspace(np.log(amplitudes.low), np.log(amplitudes.high), STEPS))
        sized = [at(length, a) for a in grid]
        for _ in range(HALVINGS):
            tops = np.array([(prior + one.views).max(axis=1) for one in sized])
            tops += log_half_cauchy(np.exp(grid), structure)[:, None]
            best = tops.max(axis=0)  # of this length: a peak may lie between two points
            # axis by axis only where they may differ
            views = (0, 1, 2) if best[1] + best[2] > best[0] + prior.max() + CHANGE else (0,)
            middles = set[float]()
            for k in views:
                middles.update(_middles(grid, tops[:, k].tolist(), float(best[k])))
            if not middles:
                break
            sized += [at(length, a) for a in middles]
            grid += middles
            order = np.argsort(grid)
            grid, sized = [grid[k] for k in order], [sized[k] for k in order]
        for point, density in _combined(length, grid, sized, structure):
            points.append(point)
            log_weight.append(prior + density)
    every = np.array(log_weight)
    likely = every.max(axis=1) > every.max() - NEGLIGIBLE
    weight = np.exp(every[likely] - every.max())
    points = [p for p, k in zip(points, likely, strict=True) if k]
    return Structure(functions, amplitudes.terms, tuple(points), weight / weight.sum())


@dataclass(frozen=True, eq=False)
class _Sized:
    """One amplitude of the field, and the evidence (2, TERM_STEPS) of each axis for it."""

    amplitude: float
    axes: tuple[_Axis, _Axis]
    evidence: Float

    @property
    def views(self) -> Float:
        """Evidence (3, TERM_STEPS) of both axes together, and of each."""
        return np.stack([self.evidence.sum(axis=0), *self.evidence])


def _combined(
    length: float, grid: Sequence[float], sized: Sequence[_Sized], median: float
) -> Iterator[tuple[_Point, Float]]:
    """Amplitudes of the field on both axes, and the density of each for all of the terms."""
    width = log_widths(np.exp(grid))
    for i, u in enumerate(sized):
        for j, v in enumerate(sized):
            both = (u.amplitude, v.amplitude)
            density = float(log_half_cauchy(np.sqrt(np.mean(np.square(both))), median)) + width[i]
            if i == j:
                density += np.log(1 - UNLIKE)
            else:
                density += np.log(UNLIKE / 2) - abs(grid[i] - grid[j]) + width[j]
            point = _Point(length, both, (u.axes[0], v.axes[1]))
            yield point, density + u.evidence[0] + v.evidence[1]


def _middles(grid: Sequence[float], tops: Sequence[float], best: float) -> list[float]:
    """Middles of the intervals that have some of the density, and over which it changes."""
    out = []
    for (a, top_a), (b, top_b) in pairwise(zip(grid, tops, strict=True)):
        top = max(top_a, top_b)
        changes = top > best - NEGLIGIBLE and abs(top_a - top_b) > CHANGE
        # a peak may lie between two points of the same height
        if changes or (top > best - NEAR_TOP and b - a > WIDEST):
            out.append(0.5 * (a + b))
    return out


def _solve(factor: Float, right: Float, trans: int = 0) -> Float:
    return np.asarray(
        scipy.linalg.solve_triangular(factor, right, trans=trans, lower=True, check_finite=False)
    )
