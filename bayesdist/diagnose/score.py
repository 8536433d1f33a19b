"""Score tests of regressors: would the fit be better with these terms?

    T = U^T V^-1 U        U = sum of psi_i        psi_i = Z_i^T g_i, parameters projected out

V is the sum of psi psi^T over the stars, with the scores g given back what the fit has taken of
them: no more is assumed of the noise than that stars are independent.  Detections of one star are
not, and are added up first.  Where errors are symmetric T has exactly the mean of a chi-square and
no larger a variance; T / N has the distribution of Hotelling's statistic about zero, Beta(q / 2,
(N - q) / 2), with N stars and q regressors, and falls below it where stars count unequally.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from bayesdist.diagnose.projection import Projection
from bayesdist.diagnose.regressors import Regressors
from bayesdist.diagnose.result import Outcome, noncentrality

__all__ = ["MEATS", "independent_directions", "regressor_tests"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

MEATS = ("robust", "homoscedastic")
STARS_PER_DIRECTION = 2  # below, a covariance of the scores says nothing


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
    families = projection.functions.regressors
    chips = len(projection.sample.model.chips)
    which = [
        np.concatenate([projection.columns(one.functions, chip) for chip in range(chips)])
        for one in families
    ]
    n_stars = len(np.unique(projection.sample.star[projection.sample.used]))
    if meat == "robust":
        meats = _robust_meats(projection, which)
    else:
        meats = [projection.efficient_information[np.ix_(w, w)] for w in which]
    out = []
    for family, columns, V in zip(families, which, meats, strict=True):
        found = _tested(projection, family, columns, V, n_stars, meat)
        if found is not None:
            out.append(found)
    return out


def _robust_meats(projection: Projection, which: Sequence[Int]) -> list[Float]:
    """Covariance of the scores of each family, from those of single stars."""
    sample = projection.sample
    edges = np.cumsum([0, *map(len, which)])
    every = np.concatenate(which)
    n_stars = int(sample.star.max()) + 1
    single = n_stars == len(sample)
    of_star = np.zeros((0 if single else n_stars, len(every)))
    meats = [projection.prior_meat(columns) for columns in which]

    def add(psi: Float) -> None:
        for k, meat in enumerate(meats):
            part = psi[:, edges[k] : edges[k + 1]]
            meat += part.T @ part

    for block, coefficients, _ in projection.regressor_maps(every):
        F = projection.functions.at(sample, block.rows)
        psi = projection.star_scores(F, block, coefficients)
        if single:
            add(psi)
        else:
            np.add.at(of_star, sample.star[block.rows], psi)
    if not single:
        add(of_star)
    return meats


def _tested(
    projection: Projection,
    family: Regressors,
    columns: Int,
    V: Float,
    n_stars: int,
    meat: str,
) -> Outcome | None:
    """Outcome of one family; None where the data cannot be asked."""
    inside = projection.n_global + columns
    whole = projection.information[np.ix_(inside, inside)]
    S = projection.efficient_information[np.ix_(columns, columns)]
    N = independent_directions(whole, S, family.least)
    q = N.shape[1]
    if q == 0 or n_stars < STARS_PER_DIRECTION * q + 2:
        return None
    U, S, V = N.T @ projection.efficient_score[columns], N.T @ S @ N, N.T @ V @ N
    if meat == "robust":
        dof_residual = float(n_stars - q)
        T = float(U @ np.linalg.solve(V, U))
        p = float(stats.beta.sf(min(T / n_stars, 1.0), q / 2, dof_residual / 2))
    else:
        dof_residual, scale = _scale(projection, float(U @ np.linalg.solve(S, U)), q)
        if dof_residual < 1:
            return None
        V = V * scale
        T = float(U @ np.linalg.solve(V, U))
        p = float(stats.f.sf(T / q, q, dof_residual))
    size, noise = _sizes(projection, family, U, S, V, N)
    return Outcome(
        name=family.name,
        statistic=T,
        dof=q,
        dof_residual=dof_residual,
        p_value=p,
        size=size,
        smallest=partial(_smallest, noise, q, dof_residual),
        unit=projection.sample.model.unit,
        remedy=family.remedy,
        present=family.present,
        absent=family.absent,
    )


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


def _sizes(
    projection: Projection, family: Regressors, U: Float, S: Float, V: Float, N: Float
) -> tuple[float, float]:
    """Rms of the pattern that was found, without its noise; and that of the noise."""
    chips = len(projection.sample.model.chips)
    square = np.repeat(projection.functions.mean_square[family.functions], 2)
    Q = (N.T * np.tile(square, chips) / chips) @ N
    inverse = np.linalg.inv(S)
    step = inverse @ U
    noise = float(np.trace(Q @ inverse @ V @ inverse))
    return float(np.sqrt(max(step @ Q @ step - noise, 0.0))), float(np.sqrt(max(noise, 0.0)))


def _smallest(noise: float, dof: float, dof_residual: float | None, level: float) -> float:
    """Rms of a pattern in any direction of the noise that has the power to be found."""
    return float(noise * np.sqrt(noncentrality(level, dof, dof_residual) / dof))
