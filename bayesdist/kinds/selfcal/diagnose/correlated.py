"""Discrepancy of a self-calibration, estimated from its residuals with the stars eliminated.

The method is that for matched stars (`diagnose.correlated.estimate`) with one difference: fitted
stars follow the common displacement of their detections, which couples axes and chips.  The
structure on all of them is therefore one part of a common posterior with the same amplitudes and
correlation length.
"""

from __future__ import annotations

import numpy as np

from bayesdist.diagnose.correlated.deviations import deviation_draws
from bayesdist.diagnose.correlated.functions import MIN_SIDE, StructureFunctions
from bayesdist.diagnose.correlated.information import not_narrower
from bayesdist.diagnose.correlated.priors import DiscrepancyPriors
from bayesdist.diagnose.correlated.result import (
    ChipStructure,
    Discrepancy,
    structure_correlation,
)
from bayesdist.diagnose.correlated.structure import structure_posterior
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.kinds.selfcal.diagnose.eliminated import (
    AddedColumns,
    EvenStars,
    eliminated,
    score_excess,
    scores_of_detections,
    squared_scores,
    without_parameters,
)
from bayesdist.kinds.selfcal.infer.mode import SelfCalibrationMode
from bayesdist.kinds.selfcal.infer.problem import Problem
from bayesdist.utils.arrays import Float

DRAWS = 2000
MAX_SINES = 700  # of all axes and chips together, because their information is decomposed
# correlation lengths of the field, in longer half sides; equal prior probabilities
LENGTHS = np.geomspace(0.08, 0.6, 5)


@one_thread
def selfcal_discrepancy(
    solution: SelfCalibrationMode,
    *,
    rng: np.random.Generator,
    priors: DiscrepancyPriors | None = None,
) -> Discrepancy:
    """Discrepancy of a self-calibration at its mode, with priors on its size.

    The result is in the gauge of the solution: fixed parameters have no errors.

    Parameters
    ----------
    solution : SelfCalibrationMode
        Mode of the self-calibration.
    rng : numpy.random.Generator
        Source of random numbers.
    priors : DiscrepancyPriors, optional
        Prior medians of the sizes.

    Returns
    -------
    Discrepancy
    """
    priors, model = priors or DiscrepancyPriors(), solution.problem.model
    working = scores_of_detections(solution)
    flat = working.flattened(score_excess(solution, working))
    cov = solution.cov
    noise, ratio = not_narrower(squared_scores(solution, working).by_evidence, cov)

    star_subset = EvenStars.of(solution)
    flat, working = flat.at(star_subset.rows), working.at(star_subset.rows)
    functions, deviations = _functions(star_subset.problem), star_subset.deviating()
    columns = AddedColumns(star_subset.problem, solution.theta, functions, deviations)
    N, score, response = eliminated(columns, flat, star_subset.stars, working=working)
    efficient = without_parameters(solution, N, score)
    S, score = efficient.information, efficient.score
    # effect of a unit of each function on the fit to all detections
    D, all_of_them = model.n_params, len(solution.problem) / len(star_subset.problem)
    response = cov @ response[:, D:] * all_of_them

    m = 2 * sum(f.n_known for f in functions.values())
    structures, theta, sizes = _structure(
        solution, functions, (S[:m, :m], score[:m], response[:, :m]), priors, rng
    )
    facts: dict[str, object] = {"structure": sizes, "unit": model.unit, "noise_ratio": ratio}
    facts["structure_correlation"] = structure_correlation(model, structures, theta)
    linear = None
    if deviations is not None:
        linear = deviation_draws(
            deviations, S[m:, m:], score[m:], response[:, m:], priors, DRAWS, rng
        )
        facts |= linear.facts
        if linear.outlying:
            facts["exposures_outlying"] = [model.exposures[code] for code in linear.outlying]
    if model.frames != "affine" and not (linear and linear.scatter):
        facts["exposures_measured"] = False
    return Discrepancy(model, solution.theta, cov, noise, structures, theta, linear, facts)


def _functions(problem: Problem) -> dict[int, StructureFunctions]:
    """Structure functions of each chip (by code) that has detections."""
    model = problem.model
    n = np.bincount(problem.groups.chip[problem.groups.index], minlength=len(model.chips))
    used = np.flatnonzero(n)
    # sines within a circle of frequencies: side squared, times pi / 4
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
    S, score, response = sums
    posterior = structure_posterior(
        [[chip_functions for chip_functions in functions.values() for _ in "uv"]],
        [S],
        [score],
        noise=pixel * float(np.sqrt(np.median(problem.var) + solution.mixture.jitter**2)),
        higher_order=priors.higher_order * pixel,
        structure=priors.structure * pixel,
        lengths=LENGTHS,
    )
    waves = {code: chip_functions.finer_waves(rng) for code, chip_functions in functions.items()}
    drawn = posterior.draws(DRAWS, rng, [[w for w in waves.values() for _ in "uv"]])
    out, rows, coefficients = dict[int, ChipStructure](), list[dict[str, object]](), []
    for k, (code, chip_functions) in enumerate(functions.items()):
        chip, pair = model.chips[code], drawn[2 * k : 2 * k + 2]
        chip_structure = ChipStructure(chip_functions, waves[code], np.stack(pair, axis=1))
        rows += chip_structure.sizes(chip, posterior.length)
        out[chip.number] = chip_structure
        coefficients += [axis[:, : chip_functions.n_known] for axis in pair]
    # the fit absorbs structure into polynomials, so that its error has the opposite sign
    return out, -np.concatenate(coefficients, axis=1) @ response.T, rows
