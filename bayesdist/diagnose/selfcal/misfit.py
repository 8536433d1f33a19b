"""Does the model describe the detections if the positions of stars are fitted with it?

Stars absorb part of any pattern that is fixed on the detector: all of it if the exposures are not
dithered, and next to nothing if a star's many detections are far apart.  The test is therefore for
shifts of cells that the model lacks, with the stars eliminated.  Let g be the gradient of the log
density with respect to these shifts and C their curvature (Rao's score test):

    g^T C^+ g

The statistic includes the patterns that the detections determine, with the means of the polynomials
over the cells projected out.  It is compared with the remaining chi-square (an F test).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from bayesdist.diagnose.residuals.misfit import Misfit, bin_means, partitions_for, worst_misfit
from bayesdist.diagnose.selfcal.scores import StarBlock, star_blocks
from bayesdist.infer.selfcal import SelfCalibrationMode
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.model.basis import polynomial_terms
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import f_sf

MAX_SIDE = 16  # cells along each side of a chip
MAX_CELLS = 512  # of all chips together, because the matrix of all shifts is decomposed
MIN_INFORMATION = 0.05  # of a direction, relative to that for known stars


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
    pull = w[:, None] * some.residual
    sums.gradient[:] += np.bincount(index.ravel(), pull.ravel(), minlength=n)
    sums.weight[:] += np.bincount(index.ravel(), np.repeat(w, 2), minlength=n)
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
    determined = values > MIN_INFORMATION
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
