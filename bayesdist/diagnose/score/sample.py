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

SAMPLE = 200_000  # largest number of detections that are tested
LARGEST_BLOCK = 4096  # detections per block, so that their functions fit into the cache


@dataclass(frozen=True, eq=False)
class DetectionBlock:
    """Detections of one chip, exposure and epoch, or a part of them, that share one polynomial."""

    rows: slice
    chip: int  # index into the model's chips
    exposure: int  # index into the exposures of the data
    frame_exposure: int  # index of the exposure that defines their frame
    frame: Float  # (2, 2) linear part of that frame
    effective: Float  # (2, K) coefficients of the polynomial, with frame and drift applied
    columns: Int  # (m,) parameters that the polynomial depends on
    # (2, K, m) derivatives of the effective coefficients with respect to these parameters
    derivative: Float

    def moved(self, by: Float) -> Float:
        """Change (2, K, n) of the polynomial due to changes `by` (D, n) of the parameters."""
        return np.asarray(self.derivative @ by[self.columns])


@dataclass(frozen=True, eq=False)
class ScoredSample:
    """Detections ordered by block, with gradient and curvature of their log-likelihood."""

    model: DistortionModel
    # X, Y (N,): detector position scaled to the interval from -1 to 1
    X: Float
    Y: Float
    score: Float  # (2, N) gradient of the log-likelihood with respect to the model's u and v
    curvature: Float  # (3, N) minus the second derivatives uu, uv, vv
    residual: Float  # (2, N) data minus model
    variance: Float  # (2, N) squared errors of true matches along u and v, jitter included
    # (N,) probability of being a true match; for a least-squares fit, 1 if the detection is used
    inlier: Float
    mag: Float | None  # (N,)
    colour: Float | None
    epoch: Float | None
    # (N,) number of the star, or of the tight group of stars, from 0; its detections share the
    # error of the reference position
    star: Int
    # chip, exposure (N,): indices into the model's chips and into the exposures of the data
    chip: Int
    exposure: Int
    # (N, 2, 2) linear part of the frame of each detection's exposure, from the detector axes to
    # those of u and v
    turn: Float
    has_catalogue: bool = True  # False if the positions of the stars were fitted
    # position, offset (2, N): ideal position, and pointing offset of the exposure relative to the
    # other exposures, in half sides of the detector along its axes; None unless pointings are
    # fitted
    position: Float | None = None
    offset: Float | None = None
    blocks: tuple[DetectionBlock, ...] = ()  # empty if the model's derivatives are not needed
    motion: Float | None = None  # (2, N) proper motions along u and v, in the unit of u, v per year
    motion_sigma: Float | None = None  # (2, N) their standard errors, if the table has them
    # (2, N) leverage: fraction of the noise of each detection that the fit follows, along u and v
    # or, if errors are correlated, their mean on both; 0 if it has not been computed
    leverage: Float | float = 0.0
    from_nominal: Float | None = None  # (2, N) data minus nominal positions, if the table has them
    match_radius: float | None = None  # stated radius within which the stars were matched
    mixture: Constants | None = None  # of the likelihood, if it models false matches
    covariance: Float | None = None  # (N,) of the errors in u and v; None if they are independent

    def __len__(self) -> int:
        return len(self.X)

    @property
    def used(self) -> Bool:
        """Boolean mask (N,) that is False for detections that the fit rejects."""
        return np.any(self.curvature != 0, axis=0)

    def along_detector(self, direction: Float) -> Float:
        """Components (2, N) along the detector axes of a displacement on the sky.

        The displacement (2,) or (2, N) is along u and v.
        """
        on_sky = np.broadcast_to(np.reshape(direction, (2, -1)), self.score.shape)
        return np.asarray(np.linalg.solve(self.turn, on_sky.T[..., None])[..., 0].T)

    @cached_property
    def whitened(self) -> Float:
        """Residuals (2, N) of unit covariance for true matches: in units of their errors.

        Correlated residuals are multiplied by the symmetric root of the inverse covariance, which
        turns them least.
        """
        if self.covariance is None:
            return np.asarray(self.residual / np.sqrt(self.variance))
        uu, vv = self.variance
        uv = self.covariance
        # root of a symmetric 2 x 2 matrix C: (C + d) / t, with d^2 = |C| and t^2 = trace + 2 d
        d = np.sqrt(uu * vv - uv**2)
        t = np.sqrt(uu + vv + 2 * d)
        u, v = self.residual
        return np.asarray(np.stack([(vv + d) * u - uv * v, (uu + d) * v - uv * u]) / (d * t))

    @cached_property
    def whole_score(self) -> Float:
        """Score (2, N), corrected for the leverage of the fit (Bell and McCaffrey 2002)."""
        return np.asarray(self.score / np.sqrt(1.0 - self.leverage))

    @cached_property
    def share(self) -> Float:
        """Weight (N,) of each used detection: the inverse number of used detections of its star."""
        number = np.bincount(self.star, self.used)
        return np.asarray(1.0 / np.maximum(number, 1.0)[self.star])

    @cached_property
    def on_detector(self) -> tuple[Float, Float]:
        """Score and diagonal of the curvature, (N, 2) each, along the axes of the polynomials.

        The score is `whole_score`.
        """
        uu, uv, vv = self.curvature
        matrix = np.stack([np.stack([uu, uv], -1), np.stack([uv, vv], -1)], -2)
        score = np.einsum("nba,bn->na", self.turn, self.whole_score)
        return score, np.einsum("nba,nbc,nca->na", self.turn, matrix, self.turn)

    @cached_property
    def uncorrelated(self) -> tuple[Float, Float]:
        """`on_detector` along axes on which the scores are uncorrelated, summed over the stars.

        These are the axes of the polynomials if the errors are not correlated.
        """
        score, curvature = self.on_detector
        if self.covariance is None:
            return score, curvature
        axes = np.linalg.eigh(score.T @ score)[1]
        uu, uv, vv = self.curvature
        matrix = np.stack([np.stack([uu, uv], -1), np.stack([uv, vv], -1)], -2)
        turn = self.turn @ axes
        return score @ axes, np.einsum("nba,nbc,nca->na", turn, matrix, turn)

    def blocks_by(self, name: str) -> list[list[DetectionBlock]]:
        """Blocks grouped by the attribute `name`: 'exposure' or 'frame_exposure'."""
        by_code: dict[int, list[DetectionBlock]] = {}
        for block in self.blocks:
            by_code.setdefault(getattr(block, name), []).append(block)
        return list(by_code.values())

    def with_positive_curvature(self) -> ScoredSample:
        """Sample in which only directions with a concave log-likelihood keep their curvature.

        Detections between true and false matches have the opposite curvature; if there are many,
        the sum of the curvatures is not a valid information matrix.
        """
        uu, uv, vv = self.curvature
        matrix = np.stack([np.stack([uu, uv], -1), np.stack([uv, vv], -1)], -2)
        values, vectors = np.linalg.eigh(matrix)
        good = np.einsum("nij,nj,nkj->nik", vectors, np.maximum(values, 0.0), vectors)
        return replace(self, curvature=np.stack([good[:, 0, 0], good[:, 0, 1], good[:, 1, 1]]))


def scored_sample(
    table: Matches,
    solution: Solution,
    match_radius: float | None = None,
    *,
    size: int = SAMPLE,
) -> ScoredSample:
    """Sample of the detections of a table, with their scores at a solution.

    The table must contain errors.  Every k-th row is used if it has more than `size` rows.
    `match_radius` is in the unit of u and v.  Raises InputError if the table does not match the
    solution.
    """
    table = table.sample(size)
    by_exposure = np.argsort(table.exposure, kind="stable")
    likelihood = likelihood_of(solution)
    stars, order = prepare(solution.model, table.select(by_exposure))
    rows = by_exposure[order]
    columns, covariance = likelihood.scores(stars), likelihood.covariances(stars)
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
        variance=covariance[0::2],
        covariance=covariance[1] if stars.is_correlated else None,
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
    """Data minus nominal positions (2, n) of the given rows.

    None if the table has no such positions.
    """
    nominal = _both(table.u_nominal, table.v_nominal, rows)
    return None if nominal is None else np.stack([table.u[rows], table.v[rows]]) - nominal


def _both(u: Float | None, v: Float | None, rows: Int) -> Float | None:
    """Two columns of a table as one array (2, n); None if either is missing."""
    return None if u is None or v is None else np.stack([u[rows], v[rows]])


def _blocks(stars: Stars, exposure: Int, theta: Float) -> tuple[DetectionBlock, ...]:
    """Divide groups into blocks of one exposure each, of at most `LARGEST_BLOCK` detections."""
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
                DetectionBlock(
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
