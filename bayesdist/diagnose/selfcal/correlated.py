"""Discrepancy of a self-calibration, estimated from its residuals with the stars eliminated.

As for matched stars (`diagnose.correlated.estimate`), with this difference: stars follow the common
part of their detections, which couples axes and chips.  So the structure on all of them has one
posterior, whose density is that of `chip_structure` with amplitudes and a correlation length in
common.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from bayesdist.diagnose.correlated.deviations import deviation_columns, deviation_draws
from bayesdist.diagnose.correlated.functions import FINE, MIN_SIDE, StructureFunctions
from bayesdist.diagnose.correlated.noise import not_narrower
from bayesdist.diagnose.correlated.priors import (
    AmplitudeGrid,
    DiscrepancyPriors,
    log_half_cauchy,
    log_widths,
)
from bayesdist.diagnose.correlated.result import ChipStructure, Discrepancy
from bayesdist.diagnose.correlated.structure import Field, SizedField
from bayesdist.diagnose.selfcal.eliminated import (
    Columns,
    eliminated,
    even_stars,
    without_parameters,
)
from bayesdist.diagnose.selfcal.sandwich import sandwich
from bayesdist.diagnose.selfcal.scores import DetectionScores, score_excess, scores_of_detections
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.selfcal.mode import SelfCalibrationMode
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.utils.arrays import Float

DRAWS = 2000
MAX_DETECTIONS = 60_000  # from which structure is estimated, at most
MAX_EXPOSURES = 150  # whose single deviations are estimated
MAX_SINES = 700  # of all axes and chips: their information is decomposed
# of the field, in longer half sides; all equally probable beforehand
LENGTHS = np.geomspace(0.08, 0.6, 5)
STEPS = 8  # of the amplitude, before the grid is refined
HALVINGS = 2
NEGLIGIBLE = 12.0  # in log density, below the largest


@one_thread
def selfcal_discrepancy(
    solution: SelfCalibrationMode,
    *,
    rng: np.random.Generator,
    priors: DiscrepancyPriors | None = None,
) -> Discrepancy:
    """Discrepancy of a self-calibration at its mode, with priors on its size.

    In the gauge of the solution: parameters that it fixes have no errors.
    """
    priors, model = priors or DiscrepancyPriors(), solution.problem.model
    working = scores_of_detections(solution)
    flat = working.flattened(score_excess(solution, working))
    cov = solution.cov
    noise, ratio = _noise(solution, working)

    some = even_stars(solution.problem, MAX_DETECTIONS)
    problem, stars = solution.problem.of_stars(some), solution.stars[some]
    chosen = np.isin(solution.problem.star, some)
    flat, working = flat.at(chosen), working.at(chosen)
    functions = _functions(problem)
    counts = np.bincount(problem.groups.index, minlength=len(problem.groups))
    deviations = deviation_columns(
        model,
        solution.theta,
        problem.groups,
        counts.astype(float),
        most=MAX_EXPOSURES,
    )
    columns = Columns(problem, solution.theta, functions, deviations)
    N, score, taken = eliminated(columns, flat, stars, working=working)
    left = without_parameters(solution, N, score)
    S, score = left.information, left.score
    # effect of a unit of each function on the fit of all detections
    D, all_of_them = model.n_params, len(solution.problem) / len(problem)
    taken = cov @ taken[:, D:] * all_of_them

    m = 2 * sum(f.n_known for f in functions.values())
    found, theta, sizes = _structure(
        solution, functions, (S[:m, :m], score[:m], taken[:, :m]), priors, rng
    )
    facts: dict[str, object] = {"structure": sizes, "unit": model.unit, "noise_ratio": ratio}
    linear = None
    if deviations is not None:
        linear = deviation_draws(deviations, S[m:, m:], score[m:], taken[:, m:], priors, DRAWS, rng)
        facts["exposures"] = linear.n_exposures
        facts["scatter"] = {k: float(np.median(v)) for k, v in linear.scatter.items()}
    if model.frames != "affine" and not (linear and linear.scatter):
        facts["exposures_measured"] = False
    return Discrepancy(model, solution.theta, cov, noise, found, theta, linear, facts)


def _noise(solution: SelfCalibrationMode, scores: DetectionScores) -> tuple[Float, float]:
    """Covariance (D, D) by the stars' scatter, and its ratio to the formal one."""
    inner = np.ix_(solution.free, solution.free)
    narrow, ratio = not_narrower(sandwich(solution, scores)[inner], solution.cov[inner])
    out = np.zeros((len(solution.theta),) * 2)
    out[inner] = narrow
    return out, ratio


def _functions(problem: Problem) -> dict[int, StructureFunctions]:
    """Functions on each chip (by code) that has detections."""
    model = problem.model
    n = np.bincount(problem.groups.chip[problem.groups.index], minlength=len(model.chips))
    used = np.flatnonzero(n)
    # sines in a circle of frequencies: a side squared, times pi / 4
    side = np.sqrt(MAX_SINES / (2 * len(used)) / (np.pi / 4))
    out = {}
    for code in used:
        size = model.chips[code].size
        wanted = StructureFunctions.for_stars(model.order, size, int(n[code]))
        out[int(code)] = StructureFunctions(
            model.order, size, int(max(min(wanted.n_side, side), MIN_SIDE))
        )
    return out


def _structure(
    solution: SelfCalibrationMode,
    functions: dict[int, StructureFunctions],
    sums: tuple[Float, Float, Float],
    priors: DiscrepancyPriors,
    rng: np.random.Generator,
) -> tuple[dict[int, ChipStructure], Float, list[dict[str, object]]]:
    """Structure by chip number, its effect on the parameters (DRAWS, D), and its sizes."""
    problem, model = solution.problem, solution.problem.model
    pixel = model.pixel_size(solution.theta)
    S, score, taken = sums
    posterior = structure_posterior(
        [one for one in functions.values() for _ in "uv"],
        S,
        score,
        noise=pixel * float(np.sqrt(np.median(problem.var) + solution.mixture.jitter**2)),
        higher_order=priors.higher_order * pixel,
        structure=priors.structure * pixel,
    )
    drawn = posterior.draws(DRAWS, rng)
    out, rows, known = dict[int, ChipStructure](), list[dict[str, object]](), []
    for k, (code, one) in enumerate(functions.items()):
        chip, pair = model.chips[code], drawn[2 * k : 2 * k + 2]
        found = ChipStructure(one, one.finer_waves(rng), np.stack(pair, axis=1))
        rows += found.sizes(chip, posterior.length)
        out[chip.number] = found
        known += [axis[:, : one.n_known] for axis in pair]
    # the fit absorbs structure into polynomials; the truth lies on the other side
    return out, -np.concatenate(known, axis=1) @ taken.T, rows


@dataclass(frozen=True, eq=False)
class _Point:
    """One length and amplitude of the field, and the likelihood of all amplitudes of the terms."""

    length: float
    sized: SizedField
    log_density: Float  # (TERM_STEPS,), by amplitude of the terms


@dataclass(frozen=True, eq=False)
class StructurePosterior:
    """Posterior of the structure on axes and chips that are coupled."""

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
