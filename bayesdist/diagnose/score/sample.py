"""Detections with their scores: what all tests of one solution look at."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import Matches
from bayesdist.infer.posterior.likelihood import scores_of
from bayesdist.infer.posterior.memberships import star_averages
from bayesdist.infer.stars.stars import Stars, prepare
from bayesdist.infer.transforms import Solution
from bayesdist.model import DistortionModel

__all__ = ["SAMPLE", "Block", "ScoredSample", "scored_sample"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

SAMPLE = 200_000  # detections that are looked at
LARGEST_BLOCK = 4096  # detections, whose functions stay in the cache


@dataclass(frozen=True, eq=False)
class Block:
    """Detections of one chip, exposure and epoch, or some of them: one polynomial describes them.

    Parameters
    ----------
    rows : slice
    chip : int
        Code into the model's chips.
    exposure : int
        Code into the exposures of the data.
    frame_exposure : int
        Code of the exposure whose frame they have.
    frame : ndarray, shape (2, 2)
        Linear part of that frame.
    effective : ndarray, shape (2, K)
    columns : ndarray of int, shape (m,)
        Parameters that the polynomial depends on, the global ones first.
    derivative : ndarray, shape (2, K, m)
        Of the effective coefficients by them.
    """

    rows: slice
    chip: int
    exposure: int
    frame_exposure: int
    frame: Float
    effective: Float
    columns: Int
    derivative: Float


@dataclass(frozen=True, eq=False)
class ScoredSample:
    """Detections in the order of their blocks, with gradient and curvature of their likelihood.

    Parameters
    ----------
    model : DistortionModel
    X, Y : ndarray, shape (N,)
        Scaled detector position.
    score : ndarray, shape (2, N)
        Gradient of the log-likelihood by the model's u and v.
    curvature : ndarray, shape (3, N)
        Minus the second derivatives uu, uv, vv.
    residual : ndarray, shape (2, N)
        Data minus model.
    variance : ndarray, shape (2, N)
        Squared errors of true matches along u and v, jitter included.
    inlier : ndarray, shape (N,)
        Probability of being a true match; of a least-squares fit, whether it uses the detection.
    mag, colour, epoch : ndarray, shape (N,), or None
    star : ndarray of int, shape (N,)
        Number of the star, from 0: detections of one star share the error of its reference
        position.
    blocks : tuple of Block
    motion : ndarray, shape (2, N), or None
        Proper motions along u and v, in the unit of u, v per year.
    motion_sigma : ndarray, shape (2, N), or None
        Their standard errors, where the table has them.
    """

    model: DistortionModel
    X: Float
    Y: Float
    score: Float
    curvature: Float
    residual: Float
    variance: Float
    inlier: Float
    mag: Float | None
    colour: Float | None
    epoch: Float | None
    star: Int
    blocks: tuple[Block, ...]
    motion: Float | None = None
    motion_sigma: Float | None = None

    def __len__(self) -> int:
        return len(self.X)

    @property
    def used(self) -> NDArray[np.bool_]:
        """Detections that say anything: all but those that a fit rejects."""
        return np.any(self.curvature != 0, axis=0)

    def with_positive_curvature(self) -> ScoredSample:
        """The sample with what is concave in the likelihood alone.

        Detections between true and false curve the wrong way; where there are many of them, their
        sum is no information matrix.
        """
        uu, uv, vv = self.curvature
        matrix = np.stack([np.stack([uu, uv], -1), np.stack([uv, vv], -1)], -2)
        values, vectors = np.linalg.eigh(matrix)
        good = np.einsum("nij,nj,nkj->nik", vectors, np.maximum(values, 0.0), vectors)
        return replace(self, curvature=np.stack([good[:, 0, 0], good[:, 0, 1], good[:, 1, 1]]))


def scored_sample(table: Matches, solution: Solution) -> ScoredSample:
    """Detections of a table with what a solution says of each.

    Parameters
    ----------
    table : Matches
        With errors; of more than `SAMPLE` rows, every k-th is taken.
    solution : Posterior or LinearFit

    Returns
    -------
    ScoredSample

    Raises
    ------
    InputError
        As `prepare` and `scores_of`.
    """
    table = table.sample(SAMPLE)
    by_exposure = np.argsort(table.exposure, kind="stable")
    scores = scores_of(solution)
    stars, order = prepare(solution.model, table.select(by_exposure))
    rows = by_exposure[order]
    columns = scores.of(stars)
    residual = stars.residuals(scores.theta).T
    variance = np.stack([stars.var_u, stars.var_v])
    if scores.constants is None:
        inlier = (columns[2] > 0).astype(float)
    else:
        inlier = 1.0 - star_averages(stars, scores.theta[None], scores.constants)[0]
        variance = variance + scores.constants.j2[0]
    codes = np.arange(len(rows)) if table.star is None else table.star[rows]
    return ScoredSample(
        model=solution.model,
        X=stars.X,
        Y=stars.Y,
        score=columns[:2],
        curvature=columns[2:],
        residual=residual,
        variance=variance,
        inlier=inlier,
        mag=None if table.mag is None else table.mag[rows],
        colour=None if table.colour is None else table.colour[rows],
        epoch=None if table.epoch is None else table.epoch[rows],
        star=np.unique(codes, return_inverse=True)[1],
        blocks=_blocks(stars, table.exposure[rows], scores.theta),
        motion=_both(table.pm_u, table.pm_v, rows),
        motion_sigma=_both(table.sigma_pm_u, table.sigma_pm_v, rows),
    )


def _both(u: Float | None, v: Float | None, rows: Int) -> Float | None:
    """Two columns of a table as one array (2, n), where it has both."""
    return None if u is None or v is None else np.stack([u[rows], v[rows]])


def _blocks(stars: Stars, exposure: Int, theta: Float) -> tuple[Block, ...]:
    """Pieces of the groups that lie in one exposure each and are not too large."""
    model, groups = stars.model, stars.groups
    effective = model.effective(theta, groups)
    jacobian = model.effective_jacobian(theta, groups)
    out = []
    for g, (columns, derivative) in enumerate(jacobian):
        a, b = int(stars.starts[g]), int(stars.starts[g + 1])
        edges = np.union1d(
            a + 1 + np.flatnonzero(np.diff(exposure[a:b])),
            np.arange(a + LARGEST_BLOCK, b, LARGEST_BLOCK),
        )
        frame = model.frame(theta, int(groups.exposure[g]))[0]
        for first, last in zip([a, *edges], [*edges, b], strict=True):
            out.append(
                Block(
                    slice(int(first), int(last)),
                    int(groups.chip[g]),
                    int(exposure[first]),
                    int(groups.exposure[g]),
                    frame,
                    effective[g],
                    columns,
                    derivative,
                )
            )
    return tuple(out)
