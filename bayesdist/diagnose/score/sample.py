"""Detections with their scores: the data of all tests of one solution."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.infer.kernel.mixture import Constants
from bayesdist.infer.solution.solution import Solution, likelihood_of
from bayesdist.infer.stars.likelihood import MixtureAt
from bayesdist.infer.stars.stars import Stars, prepare
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Bool, Float, Int

SAMPLE = 200_000  # detections that are looked at
LARGEST_BLOCK = 4096  # detections, whose functions stay in the cache


@dataclass(frozen=True, eq=False)
class Block:
    """Detections of one chip, exposure and epoch, or some of them, with one polynomial."""

    rows: slice
    chip: int  # code into the model's chips
    exposure: int  # code into the exposures of the data
    frame_exposure: int  # code of the exposure whose frame they have
    frame: Float  # (2, 2) linear part of that frame
    effective: Float  # (2, K)
    columns: Int  # (m,) parameters that the polynomial depends on
    derivative: Float  # (2, K, m) of the effective coefficients by them

    def moved(self, by: Float) -> Float:
        """Change (2, K, n) of the polynomial by changes (D, n) of the parameters."""
        return np.asarray(self.derivative @ by[self.columns])


@dataclass(frozen=True, eq=False)
class ScoredSample:
    """Detections in the order of their blocks, with gradient and curvature of their likelihood."""

    model: DistortionModel
    # X, Y (N,): scaled detector position
    X: Float
    Y: Float
    score: Float  # (2, N) gradient of the log-likelihood by the model's u and v
    curvature: Float  # (3, N) minus the second derivatives uu, uv, vv
    residual: Float  # (2, N) data minus model
    variance: Float  # (2, N) squared errors of true matches along u and v, jitter included
    # (N,) probability of being a true match; of a least-squares fit, whether it uses the detection
    inlier: Float
    mag: Float | None  # (N,)
    colour: Float | None
    epoch: Float | None
    # (N,) number of the star, or of the tight group of stars, from 0: its detections share the
    # error of the reference position
    star: Int
    # chip, exposure (N,): codes into the model's chips, and into the exposures of the data
    chip: Int
    exposure: Int
    # (N, 2, 2) linear part of the frame of each detection's exposure, from the axes of the detector
    # to those of u and v
    turn: Float
    has_catalogue: bool = True  # not where the positions of stars were solved for
    # position, offset (2, N): ideal position, and where the exposure points beside the others, in
    # half sides of the detector along its axes; None where pointings are not solved for
    position: Float | None = None
    offset: Float | None = None
    blocks: tuple[Block, ...] = ()  # none where nothing is asked of the model's derivatives
    motion: Float | None = None  # (2, N) proper motions along u and v, in the unit of u, v per year
    motion_sigma: Float | None = None  # (2, N) their standard errors, where the table has them
    # (2, N) fraction of the noise of each detection that the fit follows, along u and v; 0 where it
    # is not known
    leverage: Float | float = 0.0
    from_nominal: Float | None = (
        None  # (2, N) data minus nominal positions, where the table has them
    )
    match_radius: float | None = None  # within which the stars were matched, as is stated
    mixture: Constants | None = None  # of the likelihood, where it models false matches

    def __len__(self) -> int:
        return len(self.X)

    @property
    def used(self) -> Bool:
        """Boolean mask (N,) of the detections that count: all but those that a fit rejects."""
        return np.any(self.curvature != 0, axis=0)

    def along_detector(self, direction: Float) -> Float:
        """Displacements (2, N) along the axes of the detector; (2,) or (2, N) along u and v."""
        on_sky = np.broadcast_to(np.reshape(direction, (2, -1)), self.score.shape)
        return np.asarray(np.linalg.solve(self.turn, on_sky.T[..., None])[..., 0].T)

    @cached_property
    def whole_score(self) -> Float:
        """Score (2, N), given back what the fit has taken (Bell and McCaffrey 2002)."""
        return np.asarray(self.score / np.sqrt(1.0 - self.leverage))

    @cached_property
    def share(self) -> Float:
        """Weight (N,) of each used detection by which those of one star count as one."""
        number = np.bincount(self.star, self.used)
        return np.asarray(1.0 / np.maximum(number, 1.0)[self.star])

    @cached_property
    def on_detector(self) -> tuple[Float, Float]:
        """Score and diagonal of the curvature (N, 2) each, along the axes of the polynomials.

        The score is `whole_score`.
        """
        uu, uv, vv = self.curvature
        matrix = np.stack([np.stack([uu, uv], -1), np.stack([uv, vv], -1)], -2)
        score = np.einsum("nba,bn->na", self.turn, self.whole_score)
        return score, np.einsum("nba,nbc,nca->na", self.turn, matrix, self.turn)

    def blocks_by(self, name: str) -> list[list[Block]]:
        """Blocks that have a code in common: 'exposure', 'frame_exposure'."""
        found: dict[int, list[Block]] = {}
        for block in self.blocks:
            found.setdefault(getattr(block, name), []).append(block)
        return list(found.values())

    def with_positive_curvature(self) -> ScoredSample:
        """Sample with what is concave in the likelihood alone.

        Detections between true and false curve the wrong way; where there are many of them, their
        sum is no information matrix.
        """
        uu, uv, vv = self.curvature
        matrix = np.stack([np.stack([uu, uv], -1), np.stack([uv, vv], -1)], -2)
        values, vectors = np.linalg.eigh(matrix)
        good = np.einsum("nij,nj,nkj->nik", vectors, np.maximum(values, 0.0), vectors)
        return replace(self, curvature=np.stack([good[:, 0, 0], good[:, 0, 1], good[:, 1, 1]]))


def scored_sample(
    table: Matches, solution: Solution, match_radius: float | None = None
) -> ScoredSample:
    """Sample of the detections of a table, with their scores at a solution.

    The table has errors; of more than `SAMPLE` rows, every k-th is taken. `match_radius` is in the
    unit of u and v. Raises InputError where the table does not go with the solution.
    """
    table = table.sample(SAMPLE)
    by_exposure = np.argsort(table.exposure, kind="stable")
    likelihood = likelihood_of(solution)
    stars, order = prepare(solution.model, table.select(by_exposure))
    rows = by_exposure[order]
    columns = likelihood.scores(stars)
    shared = table.error_codes
    codes = np.arange(len(rows)) if shared is None else shared[rows]
    blocks = _blocks(stars, table.exposure[rows], likelihood.theta)
    turn = np.empty((len(rows), 2, 2))
    for block in blocks:
        turn[block.rows] = block.frame
    return ScoredSample(
        model=solution.model,
        X=stars.X,
        Y=stars.Y,
        score=columns[:2],
        curvature=columns[2:],
        residual=stars.residuals(likelihood.theta).T,
        variance=likelihood.variances(stars),
        inlier=likelihood.inliers(stars),
        mag=None if table.mag is None else table.mag[rows],
        colour=None if table.colour is None else table.colour[rows],
        epoch=None if table.epoch is None else table.epoch[rows],
        star=np.unique(codes, return_inverse=True)[1],
        chip=np.repeat(stars.groups.chip, np.diff(stars.starts)),
        exposure=table.exposure[rows],
        turn=turn,
        blocks=blocks,
        motion=_both(table.pm_u, table.pm_v, rows),
        motion_sigma=_both(table.sigma_pm_u, table.sigma_pm_v, rows),
        from_nominal=_from_nominal(table, rows),
        match_radius=match_radius,
        mixture=likelihood.constants if isinstance(likelihood, MixtureAt) else None,
    )


def _from_nominal(table: Matches, rows: Int) -> Float | None:
    """Data minus nominal positions (2, n) of some rows, where the table has them."""
    nominal = _both(table.u_nominal, table.v_nominal, rows)
    return None if nominal is None else np.stack([table.u[rows], table.v[rows]]) - nominal


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
