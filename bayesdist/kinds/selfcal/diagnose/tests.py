"""Tests of the residuals of self-calibrations, with the stars eliminated, and their discrepancy.

**Score tests.**  The questions are those for matched stars (`diagnose.score.questions`).  The
positions of stars are among the parameters that are projected out, and the scores of a star's
detections are summed. Effects that the stars absorb cannot be tested: directions that would be far
better determined if the stars were known are left out.

**Misfit.**  Does the model describe the detections if the positions of stars are fitted with it?
Stars absorb part of any pattern that is fixed on the detector: all of it if the exposures are not
dithered, and next to nothing if a star's many detections are far apart.  The test is therefore for
shifts of cells that the model lacks, with the stars eliminated.  Let g be the gradient of the log
density with respect to these shifts, C their curvature and C^+ its pseudo-inverse.  Rao's score
test is

    g^T C^+ g

The statistic includes the patterns that the detections determine, with the means of the polynomials
over the cells projected out.  It is compared with the remaining chi-square (an F test).

**Discrepancy.**  The method is that for matched stars (`diagnose.correlated.estimate`) with one
difference: fitted stars follow the common displacement of their detections, which couples axes and
chips.  The structure on all of them is therefore one part of a common posterior with the same
amplitudes and correlation length.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from bayesdist.diagnose.correlated.deviations import QUADRATIC, deviation_draws
from bayesdist.diagnose.correlated.information import not_narrower
from bayesdist.diagnose.correlated.priors import MIN_SIDE, DiscrepancyPriors, StructureFunctions
from bayesdist.diagnose.correlated.result import (
    ChipStructure,
    Discrepancy,
    structure_correlation,
)
from bayesdist.diagnose.correlated.structure import structure_posterior
from bayesdist.diagnose.residuals.misfit import Misfit, bin_means, partitions_for, worst_misfit
from bayesdist.diagnose.score.exposures import EXPOSURES, SECOND_ORDER
from bayesdist.diagnose.score.missing_orders import chip_residuals
from bayesdist.diagnose.score.motions import MIN_MOTION_SPAN, MOTIONS, StarResiduals, motion_outcome
from bayesdist.diagnose.score.noise import noise_tests
from bayesdist.diagnose.score.questions import (
    Regressors,
    TestedFunctions,
    functions_for,
    one_of_each,
)
from bayesdist.diagnose.score.result import Family, Outcome, ScoreTest, corrected, outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.diagnose.score.shape import shape_tests
from bayesdist.diagnose.statistics import Directions, EfficientScore, hotelling_p
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.kinds.selfcal.diagnose.eliminated import (
    AddedColumns,
    EvenStars,
    SelfcalScores,
    StarBlock,
    absorbed_by_stars,
    add_products,
    eliminated,
    pieces,
    score_excess,
    scores_of_detections,
    squared_scores,
    star_blocks,
    star_scores,
    taken_by_stars,
    without_parameters,
)
from bayesdist.kinds.selfcal.infer.elimination import memberships
from bayesdist.kinds.selfcal.infer.mode import SelfCalibrationMode
from bayesdist.kinds.selfcal.infer.problem import Problem
from bayesdist.model.basis import polynomial_terms
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.distributions import f_sf

STARS_PER_DIRECTION = 2  # with fewer, the covariance of the scores is meaningless
MIN_INFORMATION = 0.02  # of a direction, relative to that for known stars
UNDITHERED = 1e-3  # of half a side: smaller pointing offsets do not constrain the pointing test
EXPOSURES_OF_SELFCAL = replace(
    EXPOSURES, remedy="give selfcal.frames a scale where it has none, or leave out exposures"
)
MOTIONS_OF_SELFCAL = replace(
    MOTIONS,
    remedy="set selfcal.motion to 'proper_motion'",
    present="stars move between the dates of the exposures, and are taken to stand still",
)
DISPLACED = (
    "blends, ghosts, charge-transfer tails or trailed exposures make such residuals: cut the "
    "detections that are displaced; a higher order or larger errors do not help"
)
MAX_SIDE = 16  # cells along each side of a chip
MAX_CELLS = 512  # of all chips together, because the matrix of all shifts is decomposed
MIN_STAR_INFORMATION = 0.05  # of a direction, relative to that for known stars

DRAWS = 2000
MAX_SINES = 700  # of all axes and chips together, because their information is decomposed
# correlation lengths of the field, in longer half sides; equal prior probabilities
LENGTHS = np.geomspace(0.08, 0.6, 5)


@dataclass(frozen=True, eq=False, kw_only=True)
class _AddedColumns(AddedColumns):
    """Functions of the questions on both axes of every chip, and deviations of exposures."""

    added: TestedFunctions

    def n_functions(self, chip: int) -> int:
        """Number of functions along one axis."""
        return self.added.n_added

    def values(self, chip: int, rows: Int) -> Float:
        """Values (n, n_functions) of these functions."""
        return self.added.at(rows)[self.problem.model.n_terms :].T

    def along_axes(self, functions: Int) -> Int:
        """Columns of the given functions, chip by chip, along u and v in turn."""
        n, chips = self.n_functions(0), np.arange(len(self.problem.model.chips))
        first = functions - self.problem.model.n_terms
        return np.ravel(2 * n * chips[:, None, None] + first[:, None] + [0, n])

    def of_exposures(self, *, second_order: bool) -> Int:
        """Columns of the linear deviations of exposures, or of those of the second order."""
        if self.deviations is None:
            return np.zeros(0, int)
        n = self.deviations.n_of_exposures
        chosen = (self.deviations.scatter[:n] == QUADRATIC) == second_order
        first = 2 * self.n_functions(0) * len(self.problem.model.chips)
        return first + np.flatnonzero(chosen)


@dataclass(frozen=True, eq=False)
class _Sums:
    """Information and score of the columns that are added to the parameters."""

    known: Float  # (n, n) information for known stars and parameters
    left: EfficientScore
    covariance: Float  # (n, n) of the score, from the scores of single stars
    square: Float  # (n, n) mean products of displacements over the detections
    n_stars: int
    unit: str


def selfcal_score_tests(
    solution: SelfCalibrationMode,
    *,
    mag: Float | None = None,
    colour: Float | None = None,
    epoch: Float | None = None,
) -> tuple[ScoreTest, ...]:
    """Test a self-calibration for effects that its model lacks, and for unexpected noise.

    Tests that the data do not allow are left out.

    Parameters
    ----------
    solution : SelfCalibrationMode
        The solution to test; its problem has N detections.
    mag, colour : ndarray, shape (N,), optional
        Magnitude and colour of each detection.
    epoch : ndarray, shape (N,), optional
        Date of each detection, in decimal years.

    Returns
    -------
    tuple of ScoreTest
    """
    problem, star_subset, scores = (
        solution.problem,
        EvenStars.of(solution),
        scores_of_detections(solution),
    )
    chosen = scores.at(star_subset.rows)
    sample = _sample(solution, star_subset, chosen, mag=mag, colour=colour, epoch=epoch)
    functions = functions_for(sample)
    columns = _AddedColumns(
        star_subset.problem,
        solution.theta,
        deviations=star_subset.deviating(second_order=True),
        added=functions,
    )
    sums = _summed(solution, columns, chosen, star_subset.stars)
    outcomes = one_of_each(_regressor_tests(sums, columns, functions))
    deviating = [
        _tested(sums, family, which, np.ones(len(which), bool), np.eye(len(which)))
        for family, which in (
            (EXPOSURES_OF_SELFCAL, columns.of_exposures(second_order=False)),
            (SECOND_ORDER, columns.of_exposures(second_order=True)),
        )
    ]
    moving = None
    if epoch is not None and problem.n_star == 2 and np.ptp(epoch) > MIN_MOTION_SPAN:
        stars = StarResiduals(
            problem.star, epoch, scores.gradient, scores.curvature, problem.priors.precision
        )
        moving = motion_outcome(stars, problem.model.unit, MOTIONS_OF_SELFCAL)
    outcomes += [outcome for outcome in (*deviating, moving) if outcome is not None]
    return corrected([*_shapes(sample), *outcomes, *noise_tests(sample)])


def _shapes(sample: ScoredSample) -> list[Outcome]:
    """Outcomes of the tests of the shape of the residuals, which are along the detector axes."""
    sample = replace(sample, turn=np.broadcast_to(np.eye(2), sample.turn.shape))
    outcomes = shape_tests(sample, chip_residuals(sample))
    return [replace(one, family=replace(one.family, remedy=DISPLACED)) for one in outcomes]


def _summed(
    solution: SelfCalibrationMode, columns: _AddedColumns, scores: SelfcalScores, stars: Float
) -> _Sums:
    """Sums over the detections of a solution's stars, or of a part of them."""
    p, n, D = columns.problem, columns.sparse.stop, columns.n_params
    uneliminated, absorbed, square = (np.zeros((n, n)) for _ in range(3))
    score, psi = np.zeros(n), []
    for piece in pieces(columns):
        piece_scores = piece.scores(scores)
        sums = absorbed_by_stars(columns, piece, piece_scores, stars)
        absorbed += sums.rows.T @ sums.rows
        score -= sums.rows.T @ sums.right
        add_products(uneliminated, columns, columns, piece, piece_scores.curvature)
        add_products(square, columns, columns, piece, piece.frame.mT @ piece.frame)
        psi.append(star_scores(columns, piece, piece_scores.gradient))
    inside = np.ix_(columns.order, columns.order)
    by_star = np.concatenate(psi)
    N = (uneliminated - absorbed)[inside]
    efficient = without_parameters(solution, N, score[columns.order] + by_star.sum(axis=0))
    by_star = by_star[:, D:] - by_star[:, :D] @ efficient.gain
    # correction for the leverage of the parameters, which is small and nearly uniform
    numbers = 2 * float((scores.curvature[:, 0, 0] > 0).sum()) - p.n_star * p.n_stars
    free = max(1 - len(solution.free) / max(numbers, 1.0), 0.1)
    covariance = (
        by_star.T @ by_star / free + efficient.gain.T @ solution.prior.precision @ efficient.gain
    )
    further = np.ix_(columns.order[D:], columns.order[D:])
    return _Sums(
        uneliminated[further],
        efficient,
        covariance,
        square[further] / len(p),
        p.n_stars,
        p.model.unit,
    )


def _regressor_tests(
    sums: _Sums, columns: _AddedColumns, functions: TestedFunctions
) -> Iterator[tuple[Regressors, Outcome]]:
    """Iterate over the tests of all regressors for which there are enough stars."""
    n_chips = len(columns.problem.model.chips)
    for regressors in functions.regressors:
        indices, is_tested = columns.along_axes(regressors.every), regressors.own(n_chips)
        min_information = max(MIN_INFORMATION, regressors.least)
        result = _tested(
            sums,
            regressors.family,
            indices,
            is_tested,
            regressors.directions(n_chips),
            min_information,
        )
        if result is not None:
            yield regressors, result


def _tested(
    sums: _Sums,
    family: Family,
    which: Int,
    own: Bool,
    combinations: Float,
    least: float = MIN_INFORMATION,
) -> Outcome | None:
    """Outcome of one test; None if the data do not determine any direction.

    For `which`, `own`, `combinations` and `least` see `Directions`.
    """
    uneliminated = sums.known[np.ix_(which[own], which[own])]
    directions, n = (
        Directions.of(sums.left, which, own, combinations, uneliminated, least),
        sums.n_stars,
    )
    q = directions.q
    if q == 0 or n < STARS_PER_DIRECTION * q + 2:
        return None
    at = np.ix_(which, which)
    V = directions.basis.T @ sums.covariance[at] @ directions.basis
    T = float(directions.score @ np.linalg.solve(V, directions.score))
    square, noise = directions.squares(V, sums.square[at])
    return outcome(
        family,
        T,
        q,
        float(n - q),
        hotelling_p(T, q, n),
        square=square,
        noise=noise,
        unit=sums.unit,
    )


def _sample(
    solution: SelfCalibrationMode,
    some: EvenStars,
    scores: SelfcalScores,
    **known: Float | None,
) -> ScoredSample:
    """Sample of detections along the detector axes, in the unit of u and v.

    The detector axes are used because roll angles rotate the sky from exposure to exposure, and
    because errors are given in pixels.
    """
    problem, theta, model = solution.problem, solution.theta, solution.problem.model
    p, rows, pixel = some.problem, some.rows, model.pixel_size(theta)
    group = p.groups.index
    J = p.jacobians(theta, slice(0, len(p)))
    g = np.einsum("nab,na->nb", J, scores.gradient) / pixel
    H = np.swapaxes(J, 1, 2) @ scores.curvature @ J / pixel**2
    r = (p.places(theta) - p.star_places(some.stars))[..., None]
    residual = np.linalg.solve(J, r)[:, :, 0] * pixel
    variance = (p.var + solution.mixture.jitter**2) * pixel**2
    covariances = variance[:, None, None] * (
        np.eye(2) if p.shape is None else np.linalg.inv(p.shape)
    )
    leverage = taken_by_stars(solution)[rows]
    at_rows = {name: None if column is None else column[rows] for name, column in known.items()}
    frames = [model.frame(theta, e) for e in range(len(model.exposures))]
    position, offset = _pointings(p, theta, frames)
    return ScoredSample(
        model=model,
        X=p.X,
        Y=p.Y,
        score=g.T,
        curvature=np.stack([H[:, 0, 0], H[:, 0, 1], H[:, 1, 1]]),
        residual=np.asarray(residual.T, float),
        variance=np.stack([covariances[:, 0, 0], covariances[:, 1, 1]]),
        covariance=None if p.shape is None else covariances[:, 0, 1],
        inlier=memberships(problem, theta, solution.mixture, solution.stars)[rows],
        mag=at_rows["mag"],
        colour=at_rows["colour"],
        epoch=at_rows["epoch"],
        star=p.star,
        chip=p.groups.chip[group],
        exposure=p.groups.exposure[group],
        turn=np.stack([M for M, _ in frames])[p.groups.exposure[group]],
        has_catalogue=False,
        position=position,
        offset=offset,
        leverage=np.stack([leverage, leverage]),
    )


def _pointings(
    problem: Problem, theta: Float, frames: Sequence[tuple[Float, Float]]
) -> tuple[Float, Float | None]:
    """Positions (2, N), and pointing offsets (2, N) of the exposures, along the detector axes.

    Lengths are in half sides of the detector.  The offsets are None without dithers.
    """
    model = problem.model
    exposure = problem.groups.exposure[problem.groups.index]
    half = model.pixel_size(theta) * max(max(c.size) for c in model.chips) / 2
    on_sky = problem.places(theta) - np.asarray(model.origin)
    offsets, positions = np.zeros((len(problem), 2)), np.empty((len(problem), 2))
    for e in np.unique(exposure):
        in_exposure = exposure == e
        M, shift = frames[e]
        back = np.linalg.inv(M).T / half
        offsets[in_exposure] = shift @ back
        positions[in_exposure] = (on_sky[in_exposure] - shift) @ back
    offsets -= offsets.mean(axis=0)  # the polynomials absorb a mean offset
    return positions.T, None if np.abs(offsets).max() < UNDITHERED else offsets.T


def dithered_misfit(solution: SelfCalibrationMode) -> Misfit:
    """Misfit of a self-calibration: structure over the detector, of all chips together."""
    model, unit = solution.problem.model, solution.problem.model.pixel_size(solution.theta)
    partitions = _partitions(len(solution.problem), len(model.chips))
    misfits, n_determined, patterns = [], 0, 0
    for (name, bins), shifts in zip(
        partitions.items(), _shifts(solution, list(partitions.values())), strict=True
    ):
        result = _test(shifts, _polynomials(model.order, len(model.chips), bins))
        misfits.append(Misfit(result.p_value, name, result.pixels * unit, model.unit))
        n_determined, patterns = n_determined + result.seen, patterns + result.patterns
    return replace(worst_misfit(misfits), power=n_determined / patterns if patterns else 1.0)


def _partitions(n: int, n_chips: int) -> dict[str, tuple[int, int]]:
    """Number of bins in x and y of each chip, by the name of the partition."""
    out, max_cells = {}, MAX_CELLS // n_chips
    for name, bins in partitions_for(n // n_chips).items():
        side = min(MAX_SIDE, int(np.sqrt(max_cells))) if name == "cells" else max_cells
        nx, ny = (min(b, max(side, 2)) for b in bins)
        out[name] = nx, ny
    return out


@dataclass(frozen=True, eq=False)
class _Shifts:
    """Gradient and curvature of the log density with respect to shifts of K cells.

    Shifts are in x and y, in pixels.
    """

    gradient: Float  # (2 K,) at zero shift; x of all cells, then y
    curvature: Float  # (2 K, 2 K) with the stars eliminated
    weight: Float  # (2 K,) its diagonal for known stars
    # chi2, dof: of the residuals. The part that the shifts do not explain sets the scale: errors
    # that are too large or too small everywhere are not structure
    chi2: float = 0.0
    dof: float = 1.0


def _shifts(solution: SelfCalibrationMode, partitions: Sequence[tuple[int, int]]) -> list[_Shifts]:
    """Gradients and curvatures with respect to the shifts of each partition, in one pass."""
    p, expansion = solution.problem, solution.expansion
    out = []
    for nx, ny in partitions:
        n = 2 * len(p.model.chips) * nx * ny
        out.append(_Shifts(np.zeros(n), np.zeros((n, n)), np.zeros(n)))
    absorbed = float(len(solution.free))  # degrees of freedom absorbed by distortion and stars
    for block in star_blocks(solution):
        absorbed += np.minimum(p.n_star, 2 * np.bincount(block.star, block.member)).sum()
        for sums, bins in zip(out, partitions, strict=True):
            _add(sums, block, _cells(p, block.rows, bins))
    dof = max(2 * expansion.n_members - absorbed, 1.0)
    for sums in out:
        sums.curvature[np.diag_indices(len(sums.weight))] += sums.weight
    return [replace(sums, chi2=expansion.chi2, dof=dof) for sums in out]


def _add(sums: _Shifts, some: StarBlock, cell: Int) -> None:
    """Add a block of stars; the curvature changes by the part that they absorb."""
    w, ties, n = some.weight, some.ties, len(sums.weight)
    index = np.stack([cell, cell + n // 2], axis=1)
    pull = some.weighted(some.residual)
    sums.gradient[:] += np.bincount(index.ravel(), pull.ravel(), minlength=n)
    weights = np.repeat(w, 2)
    if some.shape is not None:
        weights = weights * np.einsum("naa->na", some.shape).ravel()
        mixed = np.bincount(cell, w * some.shape[:, 0, 1], minlength=n // 2)
        k = np.arange(n // 2)
        sums.curvature[k, k + n // 2] += mixed
        sums.curvature[k + n // 2, k] += mixed
    sums.weight[:] += np.bincount(index.ravel(), weights, minlength=n)
    q = ties.shape[1]
    row = (some.star * q)[:, None, None] + np.arange(q)[:, None]
    at = np.broadcast_arrays(row, index[:, None, :])
    of_stars = csr_array(
        (ties.ravel(), (at[0].ravel(), at[1].ravel())), shape=(q * (some.star[-1] + 1), n)
    )
    sums.curvature[:] -= (of_stars.T @ of_stars).toarray()


def _cells(problem: Problem, rows: slice, bins: tuple[int, int]) -> Int:
    """Cell (n,) of each detection, numbered over all chips."""
    nx, ny = bins
    chip = problem.groups.chip[problem.groups.index[rows]]
    X, Y = (coordinate[rows] for coordinate in problem.seen)
    return np.asarray(chip * (nx * ny) + cell_index(X, Y, bins), np.int64)


def _polynomials(order: int, n_chips: int, bins: tuple[int, int]) -> Float:
    """Means over the cells of all polynomial displacements of the chips, (2 K, fields)."""
    of_x, of_y = (bin_means(n, order) for n in bins)
    per_axis = np.stack(
        [np.outer(of_y[j], of_x[i]).ravel() for i, j in polynomial_terms(order)], axis=1
    )
    return np.kron(np.eye(2 * n_chips), per_axis)


@dataclass(frozen=True)
class _Test:
    """Result for one partition: p-value, rms in pixels, and number of determined patterns.

    `seen` of the `patterns` are determined.
    """

    p_value: float
    pixels: float
    seen: int
    patterns: int


def _test(shifts: _Shifts, fields: Float) -> _Test:
    has_weight = shifts.weight > 0
    weight = shifts.weight[has_weight]
    root = np.sqrt(weight)
    g, C = (
        shifts.gradient[has_weight] / root,
        shifts.curvature[np.ix_(has_weight, has_weight)] / np.outer(root, root),
    )
    # Orthogonal, with respect to C, to the polynomials' means over the cells: the fit has set the
    # gradient to zero along these, and nearly so along the exposures' frames.
    lost, singular, _ = np.linalg.svd(C @ (fields[has_weight] * root[:, None]), full_matrices=False)
    lost = lost[:, singular > 1e-9 * max(singular[0], 1.0)]
    free = np.linalg.svd(lost, full_matrices=True)[0][:, lost.shape[1] :]
    values, vectors = np.linalg.eigh(free.T @ C @ free)
    determined = values > MIN_STAR_INFORMATION
    if not determined.any():
        return _Test(1.0, 0.0, 0, free.shape[1])
    values, vectors = values[determined], free @ vectors[:, determined]
    along = vectors.T @ g
    k, explained = len(values), float(np.sum(along**2 / values))
    dof = max(shifts.dof - k, 1.0)
    scale = max(shifts.chi2 - explained, 0.0) / dof
    # shifts in pixels that explain g, and their noise; cells are weighted by their information
    square = (vectors @ (along / values)) ** 2
    noise = scale * np.einsum("kn,n->k", vectors**2, 1 / values)
    excess = 2 * float(np.sum(square - noise) / np.sum(weight))  # both axes together
    p = float(f_sf(explained / k / scale, k, dof)) if scale > 0 else 1.0
    return _Test(p, float(np.sqrt(max(excess, 0.0))), k, free.shape[1])


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
