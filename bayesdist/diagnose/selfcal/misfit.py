"""Does the model describe detections whose stars were fitted with it?

A pattern that belongs to the detector is hidden as far as stars can take it up: all of it where the
exposures do not move, next to nothing where a star's many detections lie far apart.  So what is
tested is a shift of each cell that the model has left out, with the stars eliminated: with g the
gradient of the log density by these shifts and C their curvature (Rao's score test),

    g^T C^+ g

over those patterns that the detections can tell, the polynomials' means over cells taken out; what
it leaves of chi-square is the unit (an F test).
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
MAX_CELLS = 512  # of all chips: the matrix of all shifts is decomposed
MIN_INFORMATION = 0.05  # of a direction, relative to that with known stars


def dithered_misfit(solution: SelfCalibrationMode) -> Misfit:
    """Misfit of a self-calibration: structure over the detector, of all chips together."""
    model, unit = solution.problem.model, solution.problem.model.pixel_size(solution.theta)
    partitions = _partitions(len(solution.problem), len(model.chips))
    found, seen, patterns = [], 0, 0
    for (name, bins), shifts in zip(
        partitions.items(), _shifts(solution, list(partitions.values())), strict=True
    ):
        one = _test(shifts, _polynomials(model.order, len(model.chips), bins))
        found.append(Misfit(one.p_value, name, one.pixels * unit, model.unit))
        seen, patterns = seen + one.seen, patterns + one.patterns
    return replace(worst_misfit(found), power=seen / patterns if patterns else 1.0)


def _partitions(n: int, n_chips: int) -> dict[str, tuple[int, int]]:
    """Bins on x and on y of each chip, by name."""
    out, most = {}, MAX_CELLS // n_chips
    for name, bins in partitions_for(n // n_chips).items():
        side = min(MAX_SIDE, int(np.sqrt(most))) if name == "cells" else most
        nx, ny = (min(b, max(side, 2)) for b in bins)
        out[name] = nx, ny
    return out


@dataclass(frozen=True, eq=False)
class _Shifts:
    """Gradient and curvature of the log density by shifts of K cells in x and in y, pixels."""

    gradient: Float  # (2 K,) of the log density at no shift; x of all cells, then y
    curvature: Float  # (2 K, 2 K) with the stars eliminated
    weight: Float  # (2 K,) its diagonal if the stars were known
    # chi2, dof: of the residuals; the rest of it is the unit: errors that are too large or too
    # small as a whole are no structure
    chi2: float = 0.0
    dof: float = 1.0


def _shifts(solution: SelfCalibrationMode, partitions: Sequence[tuple[int, int]]) -> list[_Shifts]:
    """Gradients and curvatures by shifts of the cells of each partition, in one pass."""
    p, expansion = solution.problem, solution.expansion
    out = []
    for nx, ny in partitions:
        n = 2 * len(p.model.chips) * nx * ny
        out.append(_Shifts(np.zeros(n), np.zeros((n, n)), np.zeros(n)))
    taken = float(len(solution.free))  # of the detections' numbers by distortion and stars
    for some in star_blocks(solution):
        taken += np.minimum(p.n_star, 2 * np.bincount(some.star, some.member)).sum()
        for sums, bins in zip(out, partitions, strict=True):
            _add(sums, some, _cells(p, some.rows, bins))
    dof = max(2 * expansion.n_members - taken, 1.0)
    for sums in out:
        sums.curvature[np.diag_indices(len(sums.weight))] += sums.weight
    return [replace(sums, chi2=expansion.chi2, dof=dof) for sums in out]


def _add(sums: _Shifts, some: StarBlock, cell: Int) -> None:
    """Add some stars; of the curvature what they take of it."""
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
    """Cell (n,) of each detection, counted over all chips."""
    nx, ny = bins
    chip = problem.groups.chip[problem.groups.index[rows]]
    X, Y = (seen[rows] for seen in problem.seen)
    return np.asarray(chip * (nx * ny) + cell_index(X, Y, bins), np.int64)


def _polynomials(order: int, n_chips: int, bins: tuple[int, int]) -> Float:
    """Means over the cells of what the polynomials of chips can do, (2 K, fields)."""
    of_x, of_y = (bin_means(n, order) for n in bins)
    one = np.stack([np.outer(of_y[j], of_x[i]).ravel() for i, j in polynomial_terms(order)], axis=1)
    return np.kron(np.eye(2 * n_chips), one)


@dataclass(frozen=True)
class _Test:
    """Outcome for one partition: structure is rms in pixels, `seen` of how many `patterns`."""

    p_value: float
    pixels: float
    seen: int
    patterns: int


def _test(shifts: _Shifts, fields: Float) -> _Test:
    seen = shifts.weight > 0
    weight = shifts.weight[seen]
    root = np.sqrt(weight)
    g, C = shifts.gradient[seen] / root, shifts.curvature[np.ix_(seen, seen)] / np.outer(root, root)
    # what is orthogonal by C to the polynomials' means over the cells: of those, and nearly of
    # what is lost to the exposures' frames, the fit has taken the gradient
    lost, singular, _ = np.linalg.svd(C @ (fields[seen] * root[:, None]), full_matrices=False)
    lost = lost[:, singular > 1e-9 * max(singular[0], 1.0)]
    free = np.linalg.svd(lost, full_matrices=True)[0][:, lost.shape[1] :]
    values, vectors = np.linalg.eigh(free.T @ C @ free)
    known = values > MIN_INFORMATION
    if not known.any():
        return _Test(1.0, 0.0, 0, free.shape[1])
    values, vectors = values[known], free @ vectors[:, known]
    along = vectors.T @ g
    k, explained = len(values), float(np.sum(along**2 / values))
    left = max(shifts.dof - k, 1.0)
    rest = max(shifts.chi2 - explained, 0.0) / left
    # shifts that explain g, in pixels, and their noise: a cell counts by what is seen in it
    square = (vectors @ (along / values)) ** 2
    noise = rest * np.einsum("kn,n->k", vectors**2, 1 / values)
    excess = 2 * float(np.sum(square - noise) / np.sum(weight))  # both axes together
    p = float(f_sf(explained / k / rest, k, left)) if rest > 0 else 1.0
    return _Test(p, float(np.sqrt(max(excess, 0.0))), k, free.shape[1])
