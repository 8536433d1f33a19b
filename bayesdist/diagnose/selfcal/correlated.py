"""Discrepancy of a self-calibration, estimated from its residuals with the stars eliminated.

As for matched stars (`diagnose.correlated.estimate`), with this difference: stars follow the common
part of their detections, which couples axes and chips.  So the structure on all of them is one part
of one posterior, with amplitudes and a correlation length in common.
"""

from __future__ import annotations

import numpy as np

from bayesdist.diagnose.correlated.deviations import deviation_draws
from bayesdist.diagnose.correlated.functions import MIN_SIDE, StructureFunctions
from bayesdist.diagnose.correlated.noise import not_narrower
from bayesdist.diagnose.correlated.priors import DiscrepancyPriors
from bayesdist.diagnose.correlated.result import (
    ChipStructure,
    Discrepancy,
    structure_correlation,
)
from bayesdist.diagnose.correlated.structure import structure_posterior
from bayesdist.diagnose.selfcal.eliminated import (
    Columns,
    EvenStars,
    eliminated,
    without_parameters,
)
from bayesdist.diagnose.selfcal.sandwich import squared_scores
from bayesdist.diagnose.selfcal.scores import score_excess, scores_of_detections
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.selfcal.mode import SelfCalibrationMode
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.utils.arrays import Float

DRAWS = 2000
MAX_SINES = 700  # of all axes and chips: their information is decomposed
# of the field, in longer half sides; all equally probable beforehand
LENGTHS = np.geomspace(0.08, 0.6, 5)


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
    noise, ratio = not_narrower(squared_scores(solution, working).by_evidence, cov)

    some = EvenStars.of(solution)
    flat, working = flat.at(some.rows), working.at(some.rows)
    functions, deviations = _functions(some.problem), some.deviations
    columns = Columns(some.problem, solution.theta, functions, deviations)
    N, score, taken = eliminated(columns, flat, some.stars, working=working)
    left = without_parameters(solution, N, score)
    S, score = left.information, left.score
    # effect of a unit of each function on the fit of all detections
    D, all_of_them = model.n_params, len(solution.problem) / len(some.problem)
    taken = cov @ taken[:, D:] * all_of_them

    m = 2 * sum(f.n_known for f in functions.values())
    found, theta, sizes = _structure(
        solution, functions, (S[:m, :m], score[:m], taken[:, :m]), priors, rng
    )
    facts: dict[str, object] = {"structure": sizes, "unit": model.unit, "noise_ratio": ratio}
    facts["structure_correlation"] = structure_correlation(model, found, theta)
    linear = None
    if deviations is not None:
        linear = deviation_draws(deviations, S[m:, m:], score[m:], taken[:, m:], priors, DRAWS, rng)
        facts |= linear.facts
        if linear.outlying:
            facts["exposures_outlying"] = [model.exposures[code] for code in linear.outlying]
    if model.frames != "affine" and not (linear and linear.scatter):
        facts["exposures_measured"] = False
    return Discrepancy(model, solution.theta, cov, noise, found, theta, linear, facts)


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
        [[one for one in functions.values() for _ in "uv"]],
        [S],
        [score],
        noise=pixel * float(np.sqrt(np.median(problem.var) + solution.mixture.jitter**2)),
        higher_order=priors.higher_order * pixel,
        structure=priors.structure * pixel,
        lengths=LENGTHS,
    )
    waves = {code: one.finer_waves(rng) for code, one in functions.items()}
    drawn = posterior.draws(DRAWS, rng, [[w for w in waves.values() for _ in "uv"]])
    out, rows, known = dict[int, ChipStructure](), list[dict[str, object]](), []
    for k, (code, one) in enumerate(functions.items()):
        chip, pair = model.chips[code], drawn[2 * k : 2 * k + 2]
        found = ChipStructure(one, waves[code], np.stack(pair, axis=1))
        rows += found.sizes(chip, posterior.length)
        out[chip.number] = found
        known += [axis[:, : one.n_known] for axis in pair]
    # the fit absorbs structure into polynomials; the truth lies on the other side
    return out, -np.concatenate(known, axis=1) @ taken.T, rows
