"""Score tests of regressors: would the fit be better with these terms?

    T = U^T V^-1 U        U = sum of Z_i^T g_i        V = sum of (Z_i^T g'_i) (Z_i^T g'_i)^T

Z is what the parameters leave of the regressors, g the score of a detection, g' what is left of it
when the fit has moved by one step along Z, given back what fit and step have taken.  No more is
assumed of the noise than that stars are independent; detections of one star are not, and are added
up first.  V scatters as a Wishart matrix of fewer degrees of freedom than there are stars, as those
at the edge count most, and those whose errors are quoted too small, and T as Hotelling's statistic
(Bell and McCaffrey 2002; Pustejovsky and Tipton 2018).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag

from bayesdist.diagnose.clusters import add_over
from bayesdist.diagnose.efficient import Directions
from bayesdist.diagnose.score.projection import LARGEST_LEVERAGE, Projection
from bayesdist.diagnose.score.regressors import Regressors, one_of_each
from bayesdist.diagnose.score.result import Family, Outcome, outcome
from bayesdist.diagnose.score.sample import Block
from bayesdist.diagnose.significance import chi_square_of
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import chi2_sf, f_sf

MAX_TAKEN = 0.5  # of the noise, by fit and step: what is left then says nothing of it
# power of what is left of a star's noise: 1/2 is exact where quoted errors are right (HC2), and 1,
# the jackknife, too careful there (HC3); where they are not, 1/2 takes heavy stars for better
# than they are
GIVEN_BACK = 0.75
MIN_DOF = 3  # of the noise: below, its covariance says nothing
MAX_CHIPS = 4  # that are tested together, with the covariance of all their scores


def regressor_tests(projection: Projection) -> list[Outcome]:
    """Outcomes of all regressor tests that there are stars enough for."""
    found: dict[Regressors, list[_Part]] = {}
    for chips in _chips_together(projection):
        for several, part in _parts_of(projection, chips):
            found.setdefault(several, []).append(part)
    return one_of_each(
        (several, _outcome(projection, several.family, parts)) for several, parts in found.items()
    )


@dataclass(frozen=True, eq=False)
class _Part:
    """One test on one chip, or on a few together."""

    statistic: float
    p_value: float
    dof: float
    dof_residual: float
    # square, noise: mean square of the pattern over these chips, noise included, and of the noise
    square: float
    noise: float


def _chips_together(projection: Projection) -> list[list[int]]:
    """Codes of the chips that are tested together: all, or each of many by itself."""
    chips = sorted({block.chip for block in projection.sample.blocks})
    return [chips] if len(chips) <= MAX_CHIPS else [[one] for one in chips]


def _outcome(projection: Projection, family: Family, parts: Sequence[_Part]) -> Outcome:
    """Outcome of one family, from its parts."""
    T, dof = parts[0].statistic, float(sum(one.dof for one in parts))
    residual: float | None = parts[0].dof_residual
    p = parts[0].p_value
    if len(parts) > 1:
        T = sum(chi_square_of(one.p_value, one.dof) for one in parts)
        residual, p = None, float(chi2_sf(T, dof))
    return outcome(
        family,
        T,
        dof,
        residual,
        p,
        square=float(np.mean([one.square for one in parts])),
        noise=float(np.mean([one.noise for one in parts])),
        unit=projection.sample.model.unit,
    )


def _parts_of(projection: Projection, chips: list[int]) -> Iterator[tuple[Regressors, _Part]]:
    """Tests of all regressors on some chips."""
    asked, tried = [], []
    for several in projection.functions.regressors:
        columns = np.concatenate([projection.columns(several.every, chip) for chip in chips])
        own = several.own(len(chips))
        one = Directions.of(
            projection.regressors,
            columns,
            own,
            several.directions(len(chips)),
            projection.beside_exposures(columns[own]),
            several.least,
        )
        if one.q:
            asked.append(several)
            tried.append(one)
    sums = _star_sums(projection, chips, tried)
    for several, one, (V, spreads, taken) in zip(asked, tried, sums, strict=True):
        # as Wishart matrices that scatter as much
        quoted, found = one.q * (one.q + 1) / spreads - one.q + 1
        if taken > MAX_TAKEN or quoted < MIN_DOF:
            continue
        dof_residual = float(np.clip(found, MIN_DOF, quoted))
        dof = dof_residual + one.q - 1
        T = dof_residual / dof * float(one.score @ np.linalg.solve(V, one.score))
        p = float(f_sf(T / one.q, one.q, dof_residual))
        square = np.repeat(projection.functions.mean_square[several.every], 2)
        squares = one.squares(V, np.diag(np.tile(square, len(chips)) / len(chips)))
        yield several, _Part(T, p, one.q, dof_residual, *squares)


def _star_sums(
    projection: Projection, chips: list[int], tried: Sequence[Directions]
) -> list[tuple[Float, Float, float]]:
    """Covariance of the scores of each family, from those of single stars.

    Also how it scatters (2,), by quoted errors and by the scores, and the fraction of the noise
    that fit and step have taken from the stars that it is made of.
    """
    if not tried:
        return []
    sample = projection.sample
    n_stars = int(sample.star.max()) + 1
    single = n_stars == len(sample)
    together = _Together.of(tried)
    parts = [slice(a, b) for a, b in pairwise([*together.starts, len(together.step)])]
    V = [np.zeros((one.q, one.q)) for one in tried]
    seen = [np.zeros((one.q, one.q)) for one in tried]
    by_star = np.zeros((0 if single else n_stars, len(together.step)))
    trace, norm = np.zeros((2, n_stars, len(tried)))
    taken = np.zeros(len(tried))
    size2 = np.zeros((n_stars, len(tried)))
    blocks = [block for block in sample.blocks if block.chip in chips]
    all_chips = len(blocks) == len(sample.blocks)
    for block in blocks:
        coefficients = projection.regressor_map(block, together.columns) @ together.basis
        F = projection.functions.at(block.rows)
        x = np.stack([F.T @ coefficients[axis] for axis in (0, 1)])
        psi, both, lost = together.left_scores(projection, block, x)
        taken += lost
        star = sample.star[block.rows]
        if single:
            trace[star], norm[star] = both
            size2[star] = np.add.reduceat(psi**2, together.starts, axis=1)
            for k, part in enumerate(parts):
                V[k] += psi[:, part].T @ psi[:, part]
        else:
            for total, values in ((by_star, psi), (trace, both[0]), (norm, both[1])):
                add_over(total, star, values)
        if not all_chips:
            uu, uv, vv = sample.curvature[:, block.rows]
            for k, part in enumerate(parts):
                u, v = x[..., part]
                cross = (u.T * uv) @ v
                seen[k] += (u.T * uu) @ u + (v.T * vv) @ v + cross + cross.T
    for k, (one, part) in enumerate(zip(tried, parts, strict=True)):
        if not single:
            V[k] += by_star[:, part].T @ by_star[:, part]
        if all_chips:
            V[k] += one.basis.T @ projection.prior_meat(one.columns) @ one.basis
        else:  # what other chips and priors say, through the frames: little
            V[k] += projection.score_ratio * (np.eye(one.q) - seen[k])
    if not single:
        size2 = np.add.reduceat(by_star**2, together.starts, axis=1)
    spreads = _spreads(trace, norm, size2, np.array([np.trace(one) / len(one) for one in V]))
    taken /= trace.sum(axis=0)
    return [(one, a, float(b)) for one, a, b in zip(V, spreads, taken, strict=True)]


def _spreads(trace: Float, norm: Float, size2: Float, scale: Float) -> Float:
    """Scatter (families, 2) of the covariances of scores, as quoted errors and as scores have it.

    From trace and norm (stars, families) of each star's information, squares of its scores
    (stars, families) and the covariance (families,) of the scores of one direction.
    """
    quoted = trace**2 + norm**2
    # what normal scores of these covariances have of their fourth moment
    part = quoted / np.maximum(trace**2 + 2 * norm**2, 1e-300)
    found = (part * size2**2).sum(axis=0) / scale**2
    return np.stack([quoted.sum(axis=0), found], axis=1)


@dataclass(frozen=True, eq=False)
class _Together:
    """Directions of several families, one after the other."""

    columns: Int  # (n,)
    basis: Float  # (n, q)
    step: Float  # (q,)
    starts: Int  # (families,) where the directions of each family begin

    @classmethod
    def of(cls, tried: Sequence[Directions]) -> _Together:
        """Directions of these families."""
        return cls(
            np.concatenate([one.columns for one in tried]),
            np.asarray(block_diag(*(one.basis for one in tried))),
            np.concatenate([one.score for one in tried]),
            np.cumsum([0, *(one.q for one in tried[:-1])]),
        )

    def left_scores(
        self, projection: Projection, block: Block, x: Float
    ) -> tuple[Float, Float, Float]:
        """Scores (n, q) of detections when each family by itself is fitted too.

        Also trace and norm (2, n, families) of the information that each detection has of the
        directions x (2, n, q), and the sum (families,) of what fit and step take, times the trace.
        """

        def of_families(values: Float) -> Float:
            return np.add.reduceat(values, self.starts, axis=1)

        sample = projection.sample
        uu, uv, vv = sample.curvature[:, block.rows, None]
        moved = [of_families(one * self.step) for one in x]
        g = sample.score[:, block.rows, None] - np.stack(
            [uu * moved[0] + uv * moved[1], uv * moved[0] + vv * moved[1]]
        )
        G_uu, G_vv = np.abs(uu) * of_families(x[0] ** 2), np.abs(vv) * of_families(x[1] ** 2)
        G_uv = np.sqrt(np.abs(uu * vv)) * of_families(x[0] * x[1])
        leverage = projection.leverage[:, block.rows, None] + np.stack(
            [np.where(uu > 0, G_uu, 0.0), np.where(vv > 0, G_vv, 0.0)]
        )
        leverage = np.minimum(leverage, LARGEST_LEVERAGE)
        g = g / (1.0 - leverage) ** GIVEN_BACK
        family = np.repeat(np.arange(len(self.starts)), np.diff([*self.starts, len(self.step)]))
        psi = g[0][:, family] * x[0] + g[1][:, family] * x[1]
        lost = (leverage[0] * G_uu + leverage[1] * G_vv).sum(axis=0)
        return psi, np.stack([G_uu + G_vv, np.sqrt(G_uu**2 + 2 * G_uv**2 + G_vv**2)]), lost
