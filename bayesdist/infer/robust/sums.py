"""Scores and information of cells, exposure by exposure: one pass over the stars."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import InputError
from bayesdist.infer import kernel
from bayesdist.infer.normal import NormalEquations
from bayesdist.infer.robust.cells import Cells
from bayesdist.infer.robust.scores import Scores
from bayesdist.infer.stars import Stars
from bayesdist.model import DistortionModel, Groups, merge_groups

__all__ = ["ClusterSums", "cluster_sums", "require_room"]

Float = NDArray[np.float64]

ROOM = 1_000_000_000  # bytes of the scores of all cells in all exposures


@dataclass(frozen=True, eq=False)
class ClusterSums:
    """Sums over the stars of each cell; those of pieces of the data add.

    Parameters
    ----------
    equations : NormalEquations
        Of all cells together.
    score : ndarray, shape (G, C, 2, K)
        Gradient of the log-likelihood by the effective coefficients, by group and cell of its chip;
        C is that of the chip with most cells.  Along the axes of the polynomials, before the
        frames.
    weight : ndarray, shape (chips, C, 3, M)
        Moments of minus the second derivatives, uu, uv, vv, along the same axes.
    """

    equations: NormalEquations
    score: Float
    weight: Float

    @property
    def groups(self) -> Groups:
        """Those that have stars."""
        return self.equations.groups

    def __add__(self, other: ClusterSums) -> ClusterSums:
        equations = self.equations + other.equations
        if self.groups.same(other.groups):
            score = self.score + other.score
        else:
            _, *places = merge_groups(self.groups, other.groups)
            score = np.zeros((len(equations.groups), *self.score.shape[1:]))
            for part, at in zip((self, other), places, strict=True):
                score[at] += part.score
        return ClusterSums(equations, score, self.weight + other.weight)


def require_room(model: DistortionModel, groups: Groups, cells: Cells) -> None:
    """Refuse more cells times exposures than memory holds.

    Raises
    ------
    InputError
    """
    if 16 * model.n_terms * len(groups) * cells.most > ROOM:
        raise InputError(
            f"{cells.most} cells in {len(groups)} groups of chip, exposure and epoch are too many",
            where="cells",
            do="take fewer cells",
        )


def cluster_sums(stars: Stars, scores: Scores, cells: Cells) -> ClusterSums:
    """Sums over some stars: a task for `Shards.sum`.

    Parameters
    ----------
    stars : Stars
    scores : Scores
    cells : Cells

    Returns
    -------
    ClusterSums
    """
    model, groups, C = stars.model, stars.groups, cells.most
    K, M = model.n_terms, (model.order + 1) * (2 * model.order + 1)
    columns = scores.of(stars)
    right, weight = np.zeros((len(groups), 2, K)), np.zeros((len(groups), 3, K, K))
    score, moments = np.zeros((len(groups), C, 2, K)), np.zeros((len(model.chips), C, 3, M))
    for g, (chip, exposure) in enumerate(zip(groups.chip, groups.exposure, strict=True)):
        rows = slice(stars.starts[g], stars.starts[g + 1])
        X, Y = stars.X[rows], stars.Y[rows]
        g_score, g_moments = kernel.cluster_moments(
            X, Y, cells.codes(X, Y, int(chip)), columns[:, rows], model.order, C
        )
        right[g] = g_score.sum(axis=0)
        weight[g] = kernel.products_of(g_moments.sum(axis=0), model.order)
        turn = model.frame(scores.theta, int(exposure))[0]
        score[g] = np.einsum("ab,cak->cbk", turn, g_score)
        moments[chip] += np.einsum("pq,cqm->cpm", _turned_pairs(turn), g_moments)
    about = model.effective(scores.theta, groups)
    nothing = np.zeros((len(groups), 0, 2, K))
    equations = NormalEquations(weight, right, about, 0.0, nothing, np.zeros(0), groups)
    return ClusterSums(equations, score, moments)


def _turned_pairs(turn: Float) -> Float:
    """What T^T W T does to the entries uu, uv, vv of a symmetric W, as a matrix (3, 3)."""
    (a, b), (c, d) = turn
    return np.array(
        [[a * a, 2 * a * c, c * c], [a * b, a * d + b * c, c * d], [b * b, 2 * b * d, d * d]]
    )
