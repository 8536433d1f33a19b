"""Score tests of regressors: would the fit be better with these terms?

    T = U^T V^-1 U        U = sum of Z_i^T g_i        V = sum of (Z_i^T g'_i) (Z_i^T g'_i)^T

Z is what the parameters leave of the regressors, g the score of a detection, g' what is left of it
when the fit has moved by one step along Z, given back what fit and step have taken (HC2).  No more
is assumed of the noise than that stars are independent; detections of one star are not, and are
added up first.  V scatters as a Wishart matrix of fewer degrees of freedom than there are stars, as
those at the edge count most, and T as Hotelling's statistic (Bell and McCaffrey 2002; Pustejovsky
and Tipton 2018).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from bayesdist.diagnose.projection import LARGEST_LEVERAGE, Projection
from bayesdist.diagnose.regressors import Regressors
from bayesdist.diagnose.result import Outcome, noncentrality
from bayesdist.diagnose.sample import Block

__all__ = ["independent_directions", "regressor_tests", "smallest_pattern"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

LEAST_DOF = 3  # of the noise: below, its covariance says nothing
LEAST_P = 1e-300
MOST_CHIPS = 4  # that are tested together, with the covariance of all their scores
SQUARES = ("size2", "noise2")


def regressor_tests(projection: Projection, meat: str = "robust") -> list[Outcome]:
    """Outcomes of all regressor tests that there are stars enough for.

    Parameters
    ----------
    projection : Projection
    meat : str
        'robust', or 'homoscedastic': all errors are wrong by one factor, as an F test has it.  For
        least squares only.

    Returns
    -------
    list of Outcome
    """
    found: dict[str, list[_Part]] = {}
    for chips in _chips_together(projection):
        for name, part in _parts_of(projection, chips, meat):
            found.setdefault(name, []).append(part)
    families = {one.name: one for one in projection.functions.regressors}
    return [_outcome(projection, families[name], parts) for name, parts in found.items()]


@dataclass(frozen=True, eq=False)
class _Part:
    """One test on one chip, or on a few together.

    Parameters
    ----------
    statistic, p_value : float
    dof, dof_residual : float
    size2, noise2 : float
        Mean square of the pattern over these chips, noise included, and of the noise.
    """

    statistic: float
    p_value: float
    dof: float
    dof_residual: float
    size2: float
    noise2: float


def _chips_together(projection: Projection) -> list[list[int]]:
    """Codes of the chips that are tested together: all, or each of many by itself."""
    chips = sorted({block.chip for block in projection.sample.blocks})
    return [chips] if len(chips) <= MOST_CHIPS else [[one] for one in chips]


def _outcome(projection: Projection, family: Regressors, parts: Sequence[_Part]) -> Outcome:
    """Outcome of one family, from its parts."""
    T, dof = (float(sum(getattr(one, name) for one in parts)) for name in ("statistic", "dof"))
    size2, noise2 = (float(np.mean([getattr(p, name) for p in parts])) for name in SQUARES)
    residual: float | None = parts[0].dof_residual
    p = parts[0].p_value
    if len(parts) > 1:  # chi-square of the same probabilities, which can be added up
        T = float(sum(stats.chi2.isf(max(one.p_value, LEAST_P), one.dof) for one in parts))
        residual, p = None, float(stats.chi2.sf(T, dof))
    return Outcome(
        name=family.name,
        statistic=T,
        dof=dof,
        dof_residual=residual,
        p_value=p,
        size=float(np.sqrt(max(size2 - noise2, 0.0))),
        smallest=partial(smallest_pattern, float(np.sqrt(noise2)), dof, residual),
        unit=projection.sample.model.unit,
        remedy=family.remedy,
        present=family.present,
        absent=family.absent,
    )


def _parts_of(projection: Projection, chips: list[int], meat: str) -> Iterator[tuple[str, _Part]]:
    """Tests of all families on some chips, with the names of the families."""
    tried = []
    for family in projection.functions.regressors:
        columns = np.concatenate([projection.columns(family.functions, chip) for chip in chips])
        one = _Directions.of(projection, family, columns)
        if one.q:
            tried.append(one)
    if meat == "robust":
        sums = _star_sums(projection, chips, tried)
    else:
        sums = [(np.eye(one.q), 0.0) for one in tried]
    for one, (V, spread) in zip(tried, sums, strict=True):
        if meat == "robust":
            # as a Wishart matrix that scatters as much
            dof = one.q * (one.q + 1) / spread
            dof_residual = dof - one.q + 1
            shrink = dof_residual / dof
        else:
            dof_residual, scale = _scale(projection, float(one.score @ one.score), one.q)
            V, shrink = V * scale, 1.0
        if dof_residual < LEAST_DOF:
            continue
        T = shrink * float(one.score @ np.linalg.solve(V, one.score))
        p = float(stats.f.sf(T / one.q, one.q, dof_residual))
        square = np.repeat(projection.functions.mean_square[one.family.functions], 2)
        Q = (one.basis.T * np.tile(square, len(chips)) / len(chips)) @ one.basis
        size2, noise2 = float(one.score @ Q @ one.score), float(np.trace(Q @ V))
        yield one.family.name, _Part(T, p, one.q, dof_residual, size2, noise2)


@dataclass(frozen=True, eq=False)
class _Directions:
    """Regressors of one family that the parameters have left, in units of their information.

    Parameters
    ----------
    family : Regressors
    columns : ndarray of int, shape (n,)
    basis : ndarray, shape (n, q)
        With unit information beside all parameters.
    score : ndarray, shape (q,)
        Also the step by which the fit would move.
    """

    family: Regressors
    columns: Int
    basis: Float
    score: Float

    @property
    def q(self) -> int:
        """How many."""
        return self.basis.shape[1]

    @classmethod
    def of(cls, projection: Projection, family: Regressors, columns: Int) -> _Directions:
        """Those of a family."""
        S = projection.efficient_information(columns)
        N = independent_directions(projection.whole_information(columns), S, family.least)
        # eigenvectors: their information is diagonal
        basis = N / np.sqrt(np.einsum("nq,nm,mq->q", N, S, N, optimize=True))
        return cls(family, columns, basis, basis.T @ projection.efficient_score[columns])


def _star_sums(
    projection: Projection, chips: list[int], tried: Sequence[_Directions]
) -> list[tuple[Float, float]]:
    """Covariance of the scores of each family, from those of single stars, and how it scatters."""
    sample = projection.sample
    n_stars = int(sample.star.max(initial=0)) + 1
    single = n_stars == len(sample)
    V = [np.zeros((one.q, one.q)) for one in tried]
    seen = [np.zeros((one.q, one.q)) for one in tried]
    by_star = [np.zeros((0 if single else n_stars, one.q)) for one in tried]
    trace, norm = np.zeros((2, len(tried), n_stars))
    edges = np.cumsum([0, *(len(one.columns) for one in tried)])
    every = np.concatenate([one.columns for one in tried]) if tried else np.zeros(0, np.int64)
    all_chips = True
    for block in sample.blocks:
        if block.chip not in chips:
            all_chips = False
            continue
        coefficients = projection.regressor_map(block, every)
        F = projection.functions.at(block.rows)
        star = sample.star[block.rows]
        for k, one in enumerate(tried):
            part = coefficients[..., edges[k] : edges[k + 1]] @ one.basis
            x = [F.T @ part[axis] for axis in (0, 1)]
            psi, G = _left_scores(projection, block, x, one.score)
            both = G[0] + G[2], np.sqrt(G[0] ** 2 + 2 * G[1] ** 2 + G[2] ** 2)
            if single:
                V[k] += psi.T @ psi
                trace[k, star], norm[k, star] = both
            else:
                np.add.at(by_star[k], star, psi)
                np.add.at(trace[k], star, both[0])
                np.add.at(norm[k], star, both[1])
            if len(chips) < len(sample.model.chips):
                uu, uv, vv = sample.curvature[:, block.rows]
                cross = (x[0].T * uv) @ x[1]
                seen[k] += (x[0].T * uu) @ x[0] + (x[1].T * vv) @ x[1] + cross + cross.T
    out = []
    for k, one in enumerate(tried):
        if not single:
            V[k] += by_star[k].T @ by_star[k]
        if all_chips:
            V[k] += one.basis.T @ projection.prior_meat(one.columns) @ one.basis
        else:  # what other chips and priors say, through the frames: little
            V[k] += projection.score_ratio * (np.eye(one.q) - seen[k])
        out.append((V[k], float((trace[k] ** 2 + norm[k] ** 2).sum())))
    return out


def _left_scores(
    projection: Projection, block: Block, x: Sequence[Float], step: Float
) -> tuple[Float, Float]:
    """Scores (n, q) of detections when regressors x (n, q) of both axes are fitted too.

    Also the information (3, n) that each has of the regressors: uu, uv, vv.
    """
    sample = projection.sample
    h = sample.curvature[:, block.rows]
    moved = [one @ step for one in x]
    g = sample.score[:, block.rows] - np.stack(
        [h[0] * moved[0] + h[1] * moved[1], h[1] * moved[0] + h[2] * moved[1]]
    )
    G = np.empty((3, len(moved[0])))
    for k, (a, b) in enumerate(((0, 0), (0, 1), (1, 1))):
        size = np.sqrt(np.abs(h[2 * a] * h[2 * b]))
        G[k] = size * np.einsum("nq,nq->n", x[a], x[b])
    own = np.where(h[0::2] > 0, G[0::2], 0.0)
    leverage = np.minimum(projection.leverage[:, block.rows] + own, LARGEST_LEVERAGE)
    g = g / np.sqrt(1.0 - leverage)
    return g[0][:, None] * x[0] + g[1][:, None] * x[1], G


def independent_directions(whole: Float, left: Float, least: float) -> Float:
    """Directions of regressors that the parameters have left, (n, q).

    Parameters
    ----------
    whole, left : ndarray, shape (n, n)
        Information of the regressors before and after the parameters are projected out.
    least : float
        Fraction of it that a direction must have kept.

    Returns
    -------
    ndarray, shape (n, q)
        In units in which `whole` is the unit matrix.
    """
    diagonal = np.diag(whole)
    scale = np.zeros(len(diagonal))
    scale[diagonal > 0] = diagonal[diagonal > 0] ** -0.5
    values, vectors = np.linalg.eigh(whole * np.outer(scale, scale))
    good = values > 1e-8 * values.max(initial=1e-300)
    basis = scale[:, None] * vectors[:, good] / np.sqrt(values[good])
    kept, turn = np.linalg.eigh(basis.T @ left @ basis)
    return np.asarray(basis @ turn[:, kept > least])


def _scale(projection: Projection, gain: float, q: int) -> tuple[float, float]:
    """Degrees of freedom beside parameters and regressors, and the chi-square of each."""
    sample = projection.sample
    h = sample.curvature[[0, 2]]
    good = h > 0
    chi2 = float((sample.score[good] ** 2 / h[good]).sum())
    informative = int((projection.precision > 0).sum())
    dof = int(good.sum()) - projection.sample.model.n_params + informative - q
    return float(dof), (chi2 - gain) / max(dof, 1)


def smallest_pattern(noise: float, dof: float, dof_residual: float | None, level: float) -> float:
    """Rms of a pattern that is found with the power `POWER`.

    Parameters
    ----------
    noise : float
        Rms of the pattern that noise makes.
    dof, dof_residual : float
        Of the test.
    level : float

    Returns
    -------
    float
        Of a pattern that lies in any direction as noise does.
    """
    return float(noise * np.sqrt(noncentrality(level, dof, dof_residual) / dof))
