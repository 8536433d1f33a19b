"""What is finer than the structure's functions, from products of neighbouring stars' scores.

A pattern of a few tens of pixels is next to white noise for all functions that the stars can tell
apart, and yet stars that lie side by side have it in common.  With scores g and curvatures h of
stars whose own errors are independent, the sum of g_i g_j over pairs at a separation is zero on the
mean but for what the fit has taken of them, and a displacement with covariance C(d) adds
C(d) sum h_i h_j.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import j0

from bayesdist.data.matches import MatchTable
from bayesdist.infer.discrepancy.functions import SMOOTHNESS, StructureFunctions
from bayesdist.infer.discrepancy.information import Information
from bayesdist.infer.robust.scores import Scores
from bayesdist.infer.stars import prepare

__all__ = ["Neighbours", "SharedVariance", "neighbours_of", "shared_variance"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

EDGES = (0.0, 6.0, 12.0, 24.0, 48.0)  # of separations, in pixels
MOST_PAIRS = 2_000_000
FREQUENCIES = 600


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Stars of one chip that have neighbours, along the axes of the polynomials.

    Parameters
    ----------
    X, Y : ndarray, shape (N,)
        Scaled positions.
    score, curvature : ndarray, shape (N, 2)
        Of the working likelihood.
    pairs : ndarray of int, shape (P, 2)
        Of different stars.
    separation : ndarray, shape (P,)
        In pixels.
    """

    X: Float
    Y: Float
    score: Float
    curvature: Float
    pairs: Int
    separation: Float


@dataclass(frozen=True, eq=False)
class SharedVariance:
    """What pairs on one axis of a chip say of the covariance of their displacements.

    Parameters
    ----------
    separation : ndarray, shape (b,)
        Mean one of each bin, in longer half sides of the chip.
    weight : ndarray, shape (b,)
        Sums of h_i h_j.
    product : ndarray, shape (b,)
        Sums of g_i g_j, less what the fit has made of them.
    variance : ndarray, shape (b,)
        Of these.
    """

    separation: Float
    weight: Float
    product: Float
    variance: Float

    def of_field(self, functions: StructureFunctions, length: float) -> Callable[[float], float]:
        """Log likelihood of a field's amplitude, for a correlation length in longer half sides."""
        at_unit = self.weight * self.correlation(functions, length)

        def log_likelihood(amplitude: float) -> float:
            left = self.product - at_unit * amplitude**2
            return float(-0.5 * np.sum(left**2 / self.variance))

        return log_likelihood

    def correlation(self, functions: StructureFunctions, length: float) -> Float:
        """Covariance (b,) of what is finer than the functions, of a field of unit variance.

        Parameters
        ----------
        functions : StructureFunctions
        length : float
            Correlation length in longer half sides.
        """
        k2 = 2 * SMOOTHNESS / length**2
        # even in the distribution of the frequencies above the functions'
        beyond = (np.arange(FREQUENCIES) + 0.5) / FREQUENCIES
        k = np.sqrt((k2 + functions.cut**2) * beyond ** (-1 / SMOOTHNESS) - k2)
        return np.asarray(functions.finer(length) * j0(self.separation[:, None] * k).mean(axis=1))


def neighbours_of(
    table: MatchTable, scores: Scores, information: Information
) -> dict[int, Neighbours]:
    """Neighbours on each chip, by its code.

    Parameters
    ----------
    table : MatchTable
        The matches that a solution was made from, or some of them.  A star that is matched several
        times is no neighbour of itself: its catalogue position has one error.
    scores : Scores
        Of the solution.
    information : Information

    Returns
    -------
    dict of int to Neighbours
    """
    model = information.model
    stars, order = prepare(model, table)
    g_u, g_v, h_uu, h_uv, h_vv = scores.of(stars)
    code = np.arange(len(order)) if table.star is None else table.star[order]
    g = np.stack([g_u, g_v], axis=1)
    h = np.stack([h_uu, h_uv, h_uv, h_vv], axis=1).reshape(-1, 2, 2)
    good = (h_uu > 0) & (h_vv > 0)
    chip = np.full(len(order), -1)
    for k, (c, exposure) in enumerate(zip(stars.groups.chip, stars.groups.exposure, strict=True)):
        rows = slice(stars.starts[k], stars.starts[k + 1])
        frame = np.asarray(model.frame(scores.theta, int(exposure))[0])
        g[rows] = g[rows] @ frame
        h[rows] = frame.T @ h[rows] @ frame
        chip[rows] = c
    curvature = np.einsum("naa->na", h)
    out = {}
    for c, one in enumerate(model.chips):
        here = np.flatnonzero((chip == c) & good)
        if len(here) < 2:
            continue
        at = np.column_stack([stars.X[here] * one.size[0], stars.Y[here] * one.size[1]]) / 2
        tree, reach = cKDTree(at), EDGES[-1]
        # of very many pairs those that are nearer: a pattern is seen best in them
        expected = len(here) ** 2 * np.pi * reach**2 / (2 * one.size[0] * one.size[1])
        reach *= min(1.0, float(np.sqrt(MOST_PAIRS / expected)))
        pairs = tree.query_pairs(reach, output_type="ndarray")
        pairs = pairs[code[here][pairs[:, 0]] != code[here][pairs[:, 1]]]
        separation = np.linalg.norm(at[pairs[:, 0]] - at[pairs[:, 1]], axis=1)
        out[c] = Neighbours(
            stars.X[here], stars.Y[here], g[here], curvature[here], pairs, separation
        )
    return out


def shared_variance(
    neighbours: Neighbours,
    information: Information,
    functions: StructureFunctions,
    chip: int,
    axis: int,
    S: Float,
    score: Float,
) -> SharedVariance | None:
    """Evidence of pairs, beyond what the functions hold.

    Parameters
    ----------
    neighbours : Neighbours
    information : Information
        With the excess of the scores.
    functions : StructureFunctions
    chip : int
        Code.
    axis : int
        Of the polynomials.
    S, score : ndarray, shape (n_known, n_known) and (n_known,)
        Information and score of the functions' coefficients, the parameters eliminated.

    Returns
    -------
    SharedVariance or None
        None without pairs.
    """
    pairs = neighbours.pairs
    if len(pairs) < 2:
        return None
    side = information.sums.side
    used, X, Y = information.sums.centres(chip)
    B = functions.evaluate(X, Y)
    # the functions' coefficients, held only where the stars say next to nothing
    h = neighbours.curvature[:, axis]
    solved = B @ np.linalg.inv(S + np.median(h) * np.eye(len(S)))
    found = solved @ score
    taken = 2 * np.einsum("cm,cm->c", solved, B) - np.einsum("cm,cm->c", solved @ S, solved)
    follows = np.einsum("cm,cm->c", solved, B)
    taken = taken + _of_parameters(information, chip, axis, X, Y)
    ix, iy = (
        np.clip(((z + 1) * (0.5 * side)).astype(np.int64), 0, side - 1)
        for z in (neighbours.X, neighbours.Y)
    )
    row = np.zeros(side * side, np.int64)
    row[used] = np.arange(len(used))
    cell = row[iy * side + ix]
    g = neighbours.score[:, axis] - h * found[cell]
    i, j = pairs.T
    bins = np.searchsorted(EDGES, neighbours.separation, side="right") - 1
    m = len(EDGES) - 1
    both = h[i] * h[j]
    product = g[i] * g[j] + both * taken[cell[i]]
    # the functions follow some of what is finer, as much as of a star's own error
    density = np.bincount(cell, h, minlength=len(used))[cell[i]]
    weight = np.bincount(
        bins, both * np.clip(1 - follows[cell[i]] * density, 0.1, 1.0), minlength=m
    ).astype(float)
    total = np.bincount(bins, product, minlength=m).astype(float)
    count = np.bincount(bins, minlength=m)
    good = (count > 1) & (weight > 0)
    mean = np.divide(total, weight, out=np.zeros(m), where=weight > 0)
    variance = np.bincount(bins, (product - mean[bins] * both) ** 2, minlength=m).astype(float)
    separation = np.bincount(bins, neighbours.separation, minlength=m) / np.maximum(count, 1)
    half = max(information.model.chips[chip].size) / 2
    return SharedVariance(separation[good] / half, weight[good], total[good], variance[good])


def _of_parameters(information: Information, chip: int, axis: int, X: Float, Y: Float) -> Float:
    """Variance (C,) that the fitted polynomial has at positions on a chip, over all exposures."""
    model = information.model
    D = model.n_distortion
    mean, total = np.zeros((model.n_terms, D)), 0.0
    for cells in information.groups():
        if cells.chip == chip:
            own = cells.columns < D
            n = float(cells.count.sum())
            along = np.einsum("b,bkm->km", cells.frame[:, axis], cells.derivative[..., own])
            mean[:, cells.columns[own]] += n * along
            total += n
    J = model.basis(model.chips[chip].number).evaluate_scaled(X, Y) @ (mean / max(total, 1.0))
    return np.asarray(np.einsum("cm,mn,cn->c", J, information.covariance[:D, :D], J, optimize=True))
