"""Posterior of the structure outside polynomials where axes and chips are coupled.

Axes and chips with independent likelihoods have posteriors of their own (`chip_structure`, whose
density this is).  Where they are coupled, as by the stars of a self-calibration, they have one,
with amplitudes and a length in common.  In the eigenvectors of the sines' information, in units of
their prior at one length, every amplitude is a sum.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from bayesdist.arrays import Float
from bayesdist.diagnose.correlated.functions import FINE, StructureFunctions
from bayesdist.diagnose.correlated.priors import AmplitudeGrid, log_half_cauchy, log_widths

__all__ = ["StructurePosterior", "structure_posterior"]

# of the field, in longer half sides; all equally probable beforehand
LENGTHS = np.geomspace(0.08, 0.6, 5)
STEPS = 8  # of the amplitude, before the grid is refined
HALVINGS = 2
NEGLIGIBLE = 12.0  # in log density, below the largest


@dataclass(frozen=True, eq=False)
class _Field:
    """Likelihood of the sines, in units of their prior at one length and unit amplitude."""

    length: float
    scale: Float  # standard deviations (n,) of the sines' coefficients
    values: Float  # eigenvalues (n,) of their information
    vectors: Float  # eigenvectors (n, n)
    score: Float  # along the eigenvectors (n,)
    tied: Float  # coupling (n, T) to the terms


@dataclass(frozen=True, eq=False)
class _Point:
    """One length and amplitude of the field, and the likelihood of all amplitudes of the terms."""

    field: _Field
    amplitude: float
    values: Float  # eigenvalues of the terms' information without the sines
    vectors: Float
    score: Float  # of the terms, along these
    log_density: Float  # (TERM_STEPS,), by amplitude of the terms

    @property
    def precision(self) -> Float:
        """Precision of the sines, along their eigenvectors."""
        return np.asarray(self.field.values + self.amplitude**-2)


@dataclass(frozen=True, eq=False)
class StructurePosterior:
    """Posterior of the structure on one or several axes and chips."""

    blocks: tuple[StructureFunctions, ...]  # of each axis of each chip
    terms_amplitude: Float  # grid (TERM_STEPS,) of amplitudes of the higher orders
    points: tuple[_Point, ...]  # lengths and amplitudes of the field
    weight: Float  # posterior probability (points, TERM_STEPS) of each combination

    def draws(self, n: int, rng: np.random.Generator) -> list[Float]:
        """Coefficients (n, n_known + 2 FINE) of terms, sines and finer waves of each block."""
        decline = np.concatenate([one.decline() for one in self.blocks])
        counts = rng.multinomial(n, self.weight.ravel()).reshape(self.weight.shape)
        terms, sines, waves = [], [], []
        for point, by_terms in zip(self.points, counts, strict=True):
            m = int(by_terms.sum())
            if not m:
                continue
            amplitude = np.repeat(self.terms_amplitude, by_terms)
            precision = point.values + amplitude[:, None] ** -2
            # noise through symmetric roots, which signs and order of eigenvectors do not change
            noise = rng.standard_normal((m, len(point.values))) @ point.vectors
            drawn = (point.score / precision + noise / np.sqrt(precision)) @ point.vectors.T
            terms.append(drawn * decline)
            field, precision = point.field, point.precision
            along = (field.score - drawn @ field.tied.T) / precision
            noise = rng.standard_normal(along.shape) @ field.vectors
            along += noise / np.sqrt(precision)
            sines.append(field.scale * (along @ field.vectors.T))
            fine = [np.sqrt(one.finer(field.length)) for one in self.blocks]
            wave = rng.standard_normal((m, len(self.blocks), 2 * FINE))
            waves.append(point.amplitude * np.array(fine)[:, None] * wave)
        order = rng.permutation(n)
        by_terms, by_sines, by_waves = (np.concatenate(a)[order] for a in (terms, sines, waves))
        ends = np.cumsum([(one.n_terms, one.n_sines) for one in self.blocks], axis=0)[:-1]
        split = zip(
            np.split(by_terms, ends[:, 0], axis=1),
            np.split(by_sines, ends[:, 1], axis=1),
            np.moveaxis(by_waves, 1, 0),
            strict=True,
        )
        return [np.concatenate(parts, axis=1) for parts in split]

    @property
    def length(self) -> float:
        """Posterior mean correlation length of the field, weighted by variance, in half sides."""
        by_point = self.weight.sum(axis=1) * [p.amplitude**2 for p in self.points]
        return float(by_point @ [p.field.length for p in self.points] / by_point.sum())


def structure_posterior(
    blocks: Sequence[StructureFunctions],
    information: Float,
    score: Float,
    *,
    noise: float,
    higher_order: float,
    structure: float,
) -> StructurePosterior:
    """Posterior of the coefficients of structure functions.

    `blocks` are those of each axis of each chip with a joint likelihood; `information` (m, m) is
    that of the coefficients of all blocks, and `score` (m,) the gradient of the log-likelihood
    where they are zero, both with the part that the fit absorbs eliminated.  `noise` is the typical
    error of one star, a few times which limits the amplitudes; `higher_order` and `structure` are
    prior medians of the amplitudes, in the unit of the positions.
    """
    is_term = np.concatenate([np.arange(one.n_known) < one.n_terms for one in blocks])
    at, of = np.flatnonzero(is_term), np.flatnonzero(~is_term)
    decline = np.concatenate([one.decline() for one in blocks])
    tied = information[np.ix_(of, at)] * decline
    terms = (information[np.ix_(at, at)] * np.outer(decline, decline), score[at] * decline)
    sizes = AmplitudeGrid.of(
        np.diag(information)[at], noise=noise, higher_order=higher_order, structure=structure
    )
    amplitudes = sizes.terms

    def at_length(length: float) -> _Field:
        scale = np.sqrt(np.concatenate([one.spectrum(length) for one in blocks]))
        matrix = information[np.ix_(of, of)] * np.outer(scale, scale)
        values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
        return _Field(
            length,
            scale,
            np.maximum(values, 0.0),
            vectors,
            vectors.T @ (scale * score[of]),
            vectors.T @ (scale[:, None] * tied),
        )

    def at_point(field: _Field, log_amplitude: float) -> _Point:
        amplitude = float(np.exp(log_amplitude))
        precision = field.values + amplitude**-2
        through = field.tied / precision[:, None]
        values, vectors = np.linalg.eigh(terms[0] - field.tied.T @ through)
        values = np.maximum(values, 0.0)
        left = vectors.T @ (terms[1] - through.T @ field.score)
        evidence = 0.5 * float(np.sum(field.score**2 / precision))
        evidence -= 0.5 * float(np.log1p(field.values * amplitude**2).sum())
        by_terms = 0.5 * (left**2 / (values + amplitudes[:, None] ** -2)).sum(axis=1)
        by_terms -= 0.5 * np.log1p(values * amplitudes[:, None] ** 2).sum(axis=1)
        density = (
            by_terms + sizes.log_prior + evidence + log_half_cauchy(np.array(amplitude), structure)
        )
        return _Point(field, amplitude, values, vectors, left, density)

    found: list[tuple[_Point, float]] = []
    for length in LENGTHS:
        field = at_length(length)
        grid = list(np.linspace(np.log(sizes.low), np.log(sizes.high), STEPS))
        points = [at_point(field, a) for a in grid]
        for _ in range(HALVINGS):
            tops = [float(p.log_density.max()) for p in points]
            best = max([*tops, *(p.log_density.max() for p, _ in found)])
            grid, points = _refined(grid, points, tops, best - NEGLIGIBLE, partial(at_point, field))
        widths = log_widths(np.exp(grid))
        found += [
            (p, w)
            for p, w in zip(points, widths, strict=True)
            if p.log_density.max() > best - NEGLIGIBLE
        ]
    log_weight = np.array([p.log_density + w for p, w in found])
    weight = np.exp(log_weight - log_weight.max())
    points_of = tuple(p for p, _ in found)
    return StructurePosterior(tuple(blocks), amplitudes, points_of, weight / weight.sum())


def _refined(
    grid: list[float],
    points: list[_Point],
    tops: list[float],
    least: float,
    at_point: Callable[[float], _Point],
) -> tuple[list[float], list[_Point]]:
    """Grid with a point in the middle of each interval that has some of the density."""
    new_grid, new_points = grid[:1], points[:1]
    for k in range(1, len(grid)):
        if max(tops[k - 1], tops[k]) > least and abs(tops[k] - tops[k - 1]) > 0.3:
            middle = 0.5 * (grid[k - 1] + grid[k])
            new_grid.append(middle)
            new_points.append(at_point(middle))
        new_grid.append(grid[k])
        new_points.append(points[k])
    return new_grid, new_points
