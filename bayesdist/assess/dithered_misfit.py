"""Does the model describe detections whose stars were fitted with it?

A pattern that belongs to the detector is hidden as far as stars can take it up: all of it where the
exposures do not move, next to nothing where a star's many detections lie far apart.  So what is
tested is a shift of each cell that the model has left out, with the stars eliminated: with g the
gradient of the log density by these shifts and C their curvature (Rao's score test),

    g^T C^+ g

over those patterns that the detections can tell, polynomials taken out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.stats import chi2

from bayesdist.assess.misfit import Misfit, partitions_for
from bayesdist.infer.selfcal import Solution
from bayesdist.infer.selfcal.following import following
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.model.basis import polynomial_terms

__all__ = ["dithered_misfit"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

MOST_CELLS = 16  # along each side of a chip: the matrix of all shifts is decomposed
TOLD = 0.05  # of what detections would say of a cell if stars were known: less is not told


def dithered_misfit(solution: Solution) -> Misfit:
    """Test the detections of a self-calibration for structure over the detector.

    Parameters
    ----------
    solution : Solution

    Returns
    -------
    Misfit
        Of all chips together, since they share stars; `told` is the share of the patterns over its
        partition, polynomials apart, that the detections can tell from places of stars.
    """
    model, n = solution.problem.model, len(solution.problem)
    found = []
    for name, (nx, ny) in partitions_for(n // len(model.chips)).items():
        bins = (min(nx, MOST_CELLS), min(ny, MOST_CELLS)) if name == "cells" else (nx, ny)
        shifts = _shifts(solution, bins)
        found.append((*_test(shifts, _polynomials(model.order, len(model.chips), bins)), name))
    p, pixels, told, name = min(found)
    structure = pixels * model.pixel_size(solution.theta)
    return Misfit(min(1.0, len(found) * p), name, structure, model.unit, told=told)


@dataclass(frozen=True, eq=False)
class _Shifts:
    """What detections say of shifts of K cells in x and in y, pixels.

    Parameters
    ----------
    gradient : ndarray, shape (2 K,)
        Of the log density at no shift; x of all cells, then y.
    curvature : ndarray, shape (2 K, 2 K)
        With the stars eliminated.
    weight : ndarray, shape (2 K,)
        Its diagonal if the stars were known.
    scatter : float
        Mean square of normalised residuals: errors that are too large or too small as a whole are
        no structure.
    """

    gradient: Float
    curvature: Float
    weight: Float
    scatter: float


def _shifts(solution: Solution, bins: tuple[int, int]) -> _Shifts:
    p = solution.problem
    n = 2 * len(p.model.chips) * bins[0] * bins[1]
    gradient, curvature, weight = np.zeros(n), np.zeros((n, n)), np.zeros(n)
    for some in following(solution):
        w, ties = some.weight, some.ties
        cell = _cells(p, some.rows, bins)
        index = np.stack([cell, cell + n // 2], axis=1)
        pull = w[:, None] * some.residual
        gradient += np.bincount(index.ravel(), pull.ravel(), minlength=n)
        weight += np.bincount(index.ravel(), np.repeat(w, 2), minlength=n)
        q = ties.shape[1]
        row = (some.star * q)[:, None, None] + np.arange(q)[:, None]
        at = np.broadcast_arrays(row, index[:, None, :])
        of_stars = csr_array(
            (ties.ravel(), (at[0].ravel(), at[1].ravel())), shape=(q * (some.star[-1] + 1), n)
        )
        curvature -= (of_stars.T @ of_stars).toarray()
    curvature[np.diag_indices(n)] += weight
    return _Shifts(gradient, curvature, weight, _scatter(solution))


def _scatter(solution: Solution) -> float:
    """Mean square of normalised residuals, with what stars and distortion take of them."""
    p, e = solution.problem, solution.expansion
    taken = p.n_star * p.n_stars + len(solution.free)
    return e.chi2 / max(2 * e.n_members - taken, 1.0)


def _cells(problem: Problem, rows: slice, bins: tuple[int, int]) -> Int:
    """Cell (n,) of each detection, counted over all chips."""
    nx, ny = bins
    k, m = (
        np.clip(((seen[rows] + 1) / 2 * n).astype(np.int64), 0, n - 1)
        for seen, n in zip(problem.seen, bins, strict=True)
    )
    chip = problem.groups.chip[problem.groups.index[rows]]
    return np.asarray((chip * ny + m) * nx + k, np.int64)


def _polynomials(order: int, n_chips: int, bins: tuple[int, int]) -> Float:
    """Means over the cells of what the polynomials of chips can do, (2 K, fields)."""
    means = []
    for n in bins:
        edges = np.linspace(-1.0, 1.0, n + 1)
        whole = [legendre.Legendre.basis(k).integ()(edges) for k in range(order + 1)]
        means.append(np.diff(whole, axis=1))
    of_x, of_y = means
    one = np.stack([np.outer(of_y[j], of_x[i]).ravel() for i, j in polynomial_terms(order)], axis=1)
    return np.kron(np.eye(2 * n_chips), one)


def _test(shifts: _Shifts, fields: Float) -> tuple[float, float, float]:
    """Probability, rms of the structure in pixels, and the share of patterns that can be told."""
    seen = shifts.weight > 0
    root = np.sqrt(shifts.weight[seen])
    g, C = shifts.gradient[seen] / root, shifts.curvature[np.ix_(seen, seen)] / np.outer(root, root)
    # what is orthogonal to the polynomials by C: of those the fit has made g zero
    lost, singular, _ = np.linalg.svd(C @ (fields[seen] * root[:, None]), full_matrices=False)
    lost = lost[:, singular > 1e-9 * max(singular[0], 1.0)]
    free = np.linalg.svd(lost, full_matrices=True)[0][:, lost.shape[1] :]
    values, vectors = np.linalg.eigh(free.T @ C @ free)
    told = values > TOLD
    if not told.any():
        return 1.0, 0.0, 0.0
    values, vectors = values[told], free @ vectors[:, told]
    along = vectors.T @ g
    total = float(np.sum(along**2 / values)) / shifts.scatter
    # shifts that explain g, and their noise, back in pixels
    shift = vectors @ (along / values) / root
    noise = shifts.scatter * np.einsum("kn,n->k", vectors**2, 1 / values) / root**2
    excess = float(np.mean(shift**2 - noise)) * 2  # both axes together
    p = float(chi2.sf(total, len(values)))
    return p, float(np.sqrt(max(excess, 0.0))), len(values) / free.shape[1]
