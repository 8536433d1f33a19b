"""Posterior of the structure outside polynomials where axes and chips are coupled.

Axes and chips with independent likelihoods have posteriors of their own (`chip_structure`, whose
density this is).  Where they are coupled, as by the stars of a self-calibration, they have one,
with amplitudes and a length in common.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from bayesdist.arrays import Float
from bayesdist.diagnose.correlated.functions import FINE, StructureFunctions
from bayesdist.diagnose.correlated.priors import AmplitudeGrid, log_half_cauchy, log_widths
from bayesdist.diagnose.correlated.structure import Field, SizedField

# of the field, in longer half sides; all equally probable beforehand
LENGTHS = np.geomspace(0.08, 0.6, 5)
STEPS = 8  # of the amplitude, before the grid is refined
HALVINGS = 2
NEGLIGIBLE = 12.0  # in log density, below the largest


@dataclass(frozen=True, eq=False)
class _Point:
    """One length and amplitude of the field, and the likelihood of all amplitudes of the terms."""

    length: float
    sized: SizedField
    log_density: Float  # (TERM_STEPS,), by amplitude of the terms


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
            of_terms, of_sines = point.sized.draws(amplitude, rng)
            terms.append(of_terms * decline)
            sines.append(of_sines)
            fine = [np.sqrt(one.finer(point.length)) for one in self.blocks]
            wave = rng.standard_normal((m, len(self.blocks), 2 * FINE))
            waves.append(point.sized.amplitude * np.array(fine)[:, None] * wave)
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
        by_point = self.weight.sum(axis=1) * [p.sized.amplitude**2 for p in self.points]
        return float(by_point @ [p.length for p in self.points] / by_point.sum())


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
    order = np.argsort(~is_term, kind="stable")  # terms first
    information, score = information[np.ix_(order, order)], score[order]
    sizes = AmplitudeGrid.of(
        np.diag(information)[: is_term.sum()],
        noise=noise,
        higher_order=higher_order,
        structure=structure,
    )

    def at_point(length: float, field: Field, log_amplitude: float) -> _Point:
        amplitude = float(np.exp(log_amplitude))
        sized = field.at(amplitude)
        prior = sizes.log_prior + log_half_cauchy(np.array(amplitude), structure)
        return _Point(length, sized, sized.log_evidence(sizes.terms) + prior)

    found: list[tuple[_Point, float]] = []
    for length in LENGTHS:
        at = partial(at_point, length, Field.of(blocks, length, information, score))
        grid = list(np.linspace(np.log(sizes.low), np.log(sizes.high), STEPS))
        points = [at(a) for a in grid]
        for _ in range(HALVINGS):
            tops = [float(p.log_density.max()) for p in points]
            best = max([*tops, *(p.log_density.max() for p, _ in found)])
            grid, points = _refined(grid, points, tops, best - NEGLIGIBLE, at)
        widths = log_widths(np.exp(grid))
        found += [
            (p, w)
            for p, w in zip(points, widths, strict=True)
            if p.log_density.max() > best - NEGLIGIBLE
        ]
    log_weight = np.array([p.log_density + w for p, w in found])
    weight = np.exp(log_weight - log_weight.max())
    points_of = tuple(p for p, _ in found)
    return StructurePosterior(tuple(blocks), sizes.terms, points_of, weight / weight.sum())


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
