"""Test of linear deviations of single exposures that their frames do not fit.

Every exposure e has a statistic T_e of its own, of the shift, rotation, scale and shears that are
no parameters of its frame: a chi-square of the same probability as Hotelling's statistic, with the
covariance of the scores from its own stars.  Exposures deviate in ways of their own, and the sum of
the T_e is what is tested: it does not need the covariance of hundreds of scores.  Through the
polynomials, which all fit together, the T_e are slightly dependent; mean and variance of the sum
are those of a scaled chi-square (Satterthwaite 1946).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from bayesdist.diagnose.clusters import add_over, sums_over
from bayesdist.diagnose.efficient import EfficientScore, independent_directions, squares_of
from bayesdist.diagnose.score.projection import Projection, contracted, weighted
from bayesdist.diagnose.score.result import Family, Outcome, outcome
from bayesdist.diagnose.score.sample import Block
from bayesdist.diagnose.significance import chi_square_of, hotelling_p
from bayesdist.model.frames import LINEAR_MATRICES, frame_names
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import chi2_sf

EXPOSURES = Family(
    "exposures",
    "use a campaign, whose exposures have a hierarchy of deviations",
    "exposures deviate from each other in linear terms that their frames do not fit",
    "no deviations of single exposures are left in the residuals",
    held_by="exposures",
    denial="deviating exposures do not explain it",
)
STARS_PER_DIRECTION = 4  # of an exposure that is tested
MAX_PRODUCTS = 1e10  # of scores: beyond, those of other exposures count by their mean
INDEPENDENT = 0.02  # as for time: what the frames' curvature leaves is no deviation


@dataclass(frozen=True, eq=False)
class _Deviations:
    """One exposure's deviations, all parameters projected out."""

    score: Float  # (n,)
    information: Float  # (n, n) with all parameters projected out
    own: Float  # (n, n) with those of the exposure alone
    cross: Float  # (n, G) with the global parameters
    covariance: Float  # (n, n) of the score, from those of single detections
    square: Float  # (n, n) mean square of the deviations over the detector
    of_own: Float  # (n, n) what its own stars add to this covariance
    n_own: int  # stars of the exposure, and of all others
    n_others: int

    @property
    def n_stars(self) -> float:
        """Stars that the covariance is known from, those of others by what they add to it.

        What its own stars add is a fraction of each direction's variance: shifts and scales have
        different units.
        """
        fraction = float(np.trace(np.linalg.solve(self.covariance, self.of_own))) / len(self.score)
        return 1.0 / (fraction**2 / self.n_own + (1.0 - fraction) ** 2 / self.n_others)

    @property
    def statistic(self) -> float:
        """Chi-square of the same probability as Hotelling's statistic about zero."""
        n, t = len(self.score), float(self.score @ np.linalg.solve(self.covariance, self.score))
        return chi_square_of(hotelling_p(t, n, self.n_stars), n)

    def along(self, N: Float) -> _Deviations:
        """Deviations along some directions N (n, q)."""
        return _Deviations(
            N.T @ self.score,
            N.T @ self.information @ N,
            N.T @ self.own @ N,
            N.T @ self.cross,
            N.T @ self.covariance @ N,
            N.T @ self.square @ N,
            N.T @ self.of_own @ N,
            self.n_own,
            self.n_others,
        )


@dataclass(frozen=True, eq=False)
class _Meat:
    """Scores of the global parameters, by stars."""

    by_star: Float  # (stars, G) sums over the detections of each
    total: Float  # (G, G) sum of their squares, and what the priors add

    @classmethod
    def of(cls, projection: Projection) -> _Meat:
        """Scores of all stars."""
        sample, G = projection.sample, projection.n_global
        by_star = np.zeros((int(sample.star.max()) + 1, G))
        for block in sample.blocks:
            F = projection.functions.polynomials(block.rows)
            psi = projection.star_scores(F, block, block.moved(projection.following))
            add_over(by_star, sample.star[block.rows], psi)
        following = projection.following
        return cls(by_star, by_star.T @ by_star + following.T @ projection.precision @ following)

    def covariance(self, nuisance: Float, star: Int, own: Float) -> tuple[Float, Float]:
        """Covariance (n, n) of an exposure's scores: of its own stars, and of all others.

        `nuisance` (G, n) are the parameters that the deviations are taken for, `star` (N,) the
        stars of the exposure's detections, `own` (N, n) the scores of the detections before the
        parameters are projected out.
        """
        which, of = np.unique(star, return_inverse=True)
        # a star is one, in this exposure and in all others
        through = self.by_star[which] @ nuisance
        left = sums_over(of, own) - through
        rest = nuisance.T @ self.total @ nuisance - through.T @ through
        return left.T @ left, rest


def exposure_test(projection: Projection) -> Outcome | None:
    """Test of the exposures' own deviations.

    None where there is one exposure, where the frames fit all linear terms, and where no two
    exposures have stars enough.
    """
    model = projection.sample.model
    names = [name for name in frame_names("affine") if name not in frame_names(model.frames)]
    if not names or len({block.exposure for block in projection.sample.blocks}) < 2:
        return None
    found = list(_deviations(projection, names))
    if len(found) < 2:
        return None
    T, n = sum(one.statistic for one in found), sum(len(one.score) for one in found)
    squares = [squares_of(one.score, one.own, one.covariance, one.square) for one in found]
    apart = 0.0
    for one in found:
        alone = np.linalg.solve(one.information, one.own - one.information)
        apart += float(np.trace(alone @ alone))
    G = projection.n_global
    shared = sum(one.cross.T @ np.linalg.solve(one.information, one.cross) for one in found)
    together = projection.covariance[:G, :G] @ shared
    # mean n, variance 2 n (1 + ...), as a multiple of a chi-square
    stretch = 1.0 + (float((together * together.T).sum()) - apart) / n
    dof = n / stretch
    T = T / stretch
    square, noise = (float(values) for values in np.mean(squares, axis=0))
    remedy = EXPOSURES.remedy
    if model.frames != "affine":
        remedy = f"set model.frames to 'affine', or {remedy}"
    return outcome(
        replace(EXPOSURES, remedy=remedy),
        T,
        dof,
        None,
        float(chi2_sf(T, dof)),
        square=square,
        noise=noise,
        unit=model.unit,
    )


def _deviations(projection: Projection, names: list[str]) -> Iterator[_Deviations]:
    """Deviations of every exposure with stars enough, along the directions that it has left."""
    meat = None
    if len(projection.sample) * projection.n_global**2 < MAX_PRODUCTS:
        meat = _Meat.of(projection)
    for blocks in projection.sample.blocks_by("exposure"):
        n = sum(int(projection.sample.used[block.rows].sum()) for block in blocks)
        if n < STARS_PER_DIRECTION * len(names):
            continue
        whole, one = _of_exposure(projection, blocks, names, meat)
        N = independent_directions(whole, one.information, INDEPENDENT)
        if N.shape[1]:
            yield one.along(N)


def _fields(block: Block, names: list[str], origin: tuple[float, float]) -> Float:
    """Changes (2, K, n) of the polynomial of a block by unit deviations."""
    out = np.zeros((*block.effective.shape, len(names)))
    about = block.effective.copy()
    about[:, 0] -= origin
    for k, name in enumerate(names):
        if name in LINEAR_MATRICES:
            out[..., k] = LINEAR_MATRICES[name] @ about
        else:
            out["uv".index(name[-1]), 0, k] = 1.0
    return out


def _of_exposure(
    projection: Projection, blocks: list[Block], names: list[str], meat: _Meat | None
) -> tuple[Float, _Deviations]:
    """Information before anything is projected out, and one exposure's deviations."""
    sample, model = projection.sample, projection.sample.model
    n, D = len(names), model.n_params
    whole, cross, score = np.zeros((n, n)), np.zeros((D, n)), np.zeros(n)
    square = np.zeros((n, n))
    area = model.basis().mean_squares
    fields = [_fields(block, names, model.origin) for block in blocks]
    for block, Z in zip(blocks, fields, strict=True):
        F = projection.functions.polynomials(block.rows)
        WZ = weighted(F, sample.curvature[:, block.rows], Z)
        whole += contracted(Z, WZ)
        cross[block.columns] += contracted(block.derivative, WZ)
        score += contracted(Z, (sample.score[:, block.rows] @ F.T)[..., None])[:, 0]
        square += contracted(Z, area[:, None] * Z) / len(blocks)
    rows = np.unique(np.concatenate([block.columns for block in blocks]))
    left = EfficientScore.of(
        projection.covariance, projection.score, cross[rows], whole, score, rows
    )
    by_global = cross[rows].T @ projection.following[rows]
    of_own, of_others = _covariances(projection, blocks, fields, left, meat)
    covariance = of_own + of_others
    n_own = sum(int(sample.used[block.rows].sum()) for block in blocks)
    n_others = max(int(sample.used.sum()) - n_own, 1)
    return whole, _Deviations(
        left.score,
        left.information,
        projection.with_global(left.information, by_global),
        by_global,
        (covariance + covariance.T) / 2,
        square,
        of_own,
        n_own,
        n_others,
    )


def _covariances(
    projection: Projection,
    blocks: list[Block],
    fields: list[Float],
    left: EfficientScore,
    meat: _Meat | None,
) -> tuple[Float, Float]:
    """Covariance (n, n) of an exposure's scores: of its own stars, and of all else.

    Without the scores of the global parameters, the part of other exposures is taken to be as wrong
    as errors are on average.
    """
    sample = projection.sample
    # the global parameters, which other exposures see as well, with those of exposures following
    nuisance = left.gain[: projection.n_global]
    shared = projection.following @ nuisance
    others, psi = left.information.copy(), []
    for block, Z in zip(blocks, fields, strict=True):
        F = projection.functions.polynomials(block.rows)
        direct = Z - block.moved(left.gain)
        if meat is None:
            others -= contracted(direct, weighted(F, sample.curvature[:, block.rows], direct))
        else:
            direct += block.moved(shared)
        psi.append(projection.star_scores(F, block, direct))
    own = np.concatenate(psi)
    if meat is None:
        return own.T @ own, projection.score_ratio * others
    star = np.concatenate([sample.star[block.rows] for block in blocks])
    of_own, of_others = meat.covariance(nuisance, star, own)
    rows = np.unique(np.concatenate([block.columns for block in blocks]))
    P = projection.precision[np.ix_(rows, rows)]
    before, after = shared[rows], left.gain[rows]
    return of_own, of_others + after.T @ P @ after - before.T @ P @ before
