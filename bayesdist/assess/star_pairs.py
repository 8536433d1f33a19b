"""Sums over pairs of different stars that lie close together: noise has no part in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.robust.cells import Cells
from bayesdist.infer.robust.scores import Scores
from bayesdist.infer.stars import Stars

__all__ = ["AXES", "WIDER", "PairSums", "pair_sums"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

AXES = ((0, 0), (1, 1), (0, 1))  # u with u, v with v, u with v
WIDER = (1, 2, 4)  # sides of the cells, in those of the smallest


@dataclass(frozen=True, eq=False)
class PairSums:
    """Sums over pairs of stars in the same small cell; those of pieces of the data add.

    Parameters
    ----------
    n_pairs : ndarray of int, shape (chips,)
        In the smallest cells.
    products, weights : ndarray, shape (chips, 3, C, 3)
        sum g_i g_j and sum h_i h_j for uu, vv, uv in cells of each size, by block of the chip; C is
        that of the chip with most blocks.
    """

    n_pairs: Int
    products: Float
    weights: Float

    def __add__(self, other: PairSums) -> PairSums:
        return PairSums(
            self.n_pairs + other.n_pairs,
            self.products + other.products,
            self.weights + other.weights,
        )


def pair_sums(stars: Stars, scores: Scores, side: float, blocks: Cells) -> PairSums:
    """Sums over the pairs of some stars: a task for `Shards.sum`.

    Parameters
    ----------
    stars : Stars
    scores : Scores
    side : float
        Of the smallest cells, in pixels.
    blocks : Cells
        By which sums are kept apart.

    Returns
    -------
    PairSums
    """
    model = stars.model
    n, C = len(model.chips), blocks.most
    empty = np.zeros((n, len(WIDER), C, 3))
    out = PairSums(np.zeros(n, np.int64), empty, empty.copy())
    columns = scores.of(stars)
    for g, (chip, exposure) in enumerate(
        zip(stars.groups.chip, stars.groups.exposure, strict=True)
    ):
        rows = slice(stars.starts[g], stars.starts[g + 1])
        X, Y = stars.X[rows], stars.Y[rows]
        if len(X) < 2:
            continue
        turn = model.frame(scores.theta, int(exposure))[0]
        gradient = turn.T @ columns[:2, rows]
        curvature = np.einsum("ab,as->bs", turn**2, columns[[2, 4], rows])
        block = blocks.codes(X, Y, int(chip))
        for k, times in enumerate(WIDER):
            cell, first, n_stars = _cells(X, Y, model.chips[chip].size, times * side)
            if k == 0:
                out.n_pairs[chip] += int((n_stars * (n_stars - 1) // 2).sum())
            home = block[first]
            for p, (a, b) in enumerate(AXES):
                for sums, q in ((out.products, gradient), (out.weights, curvature)):
                    found = _pairs(cell, q[a], q[b], len(first))
                    np.add.at(sums[chip, k, :, p], home, found)
    return out


def _cells(X: Float, Y: Float, size: tuple[float, float], side: float) -> tuple[Int, Int, Int]:
    """Cell of each star, the first star of each cell that has some, and the number of stars."""
    nx, ny = (max(1, round(n / side)) for n in size)
    ix, iy = (
        np.clip(((z + 1) * (0.5 * n)).astype(np.int64), 0, n - 1) for z, n in ((X, nx), (Y, ny))
    )
    _, first, cell, count = np.unique(
        iy * nx + ix, return_index=True, return_inverse=True, return_counts=True
    )
    return cell.ravel(), first, count


def _pairs(cell: Int, a: Float, b: Float, n: int) -> Float:
    """Sum (n,) of a_i b_j over the different stars i, j of each cell."""
    whole = [np.bincount(cell, q, n) for q in (a, b)]
    return np.asarray(whole[0] * whole[1] - np.bincount(cell, a * b, n))
