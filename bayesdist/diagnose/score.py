"""Score tests of regressors: would the fit be better with these terms?

    T = U^T V^-1 U        U = sum of psi_i        psi_i = Z_i^T g_i, parameters projected out

V is the sum of psi psi^T over the stars, with the scores g given back what the fit has taken of
them: no more is assumed of the noise than that stars are independent.  Detections of one star are
not, and are added up first.  Where errors are symmetric T has exactly the mean of a chi-square and
no larger a variance; T / N has the distribution of Hotelling's statistic about zero, Beta(q / 2,
(N - q) / 2), with N stars and q regressors, and falls below it where stars count unequally.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from bayesdist.diagnose.projection import Projection
from bayesdist.diagnose.regressors import Regressors
from bayesdist.diagnose.result import Outcome, noncentrality
from bayesdist.diagnose.sample import Block

__all__ = ["independent_directions", "regressor_tests", "smallest_pattern"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

STARS_PER_DIRECTION = 2  # below, a covariance of the scores says nothing
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
    residual, p = None, float(stats.chi2.sf(T, dof))
    if len(parts) == 1:
        residual, p = parts[0].dof_residual, parts[0].p_value
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
    sample = projection.sample
    blocks = [block for block in sample.blocks if block.chip in chips]
    used = sample.used
    n_stars = len(np.unique(np.concatenate([sample.star[b.rows][used[b.rows]] for b in blocks])))
    families = projection.functions.regressors
    which = [
        np.concatenate([projection.columns(one.functions, chip) for chip in chips])
        for one in families
    ]
    if meat == "robust":
        meats = _robust_meats(projection, blocks, which)
    else:
        meats = [projection.efficient_information(columns) for columns in which]
    for family, columns, V in zip(families, which, meats, strict=True):
        whole = projection.whole_information(columns)
        S = projection.efficient_information(columns)
        N = independent_directions(whole, S, family.least)
        q = N.shape[1]
        if q == 0 or n_stars < STARS_PER_DIRECTION * q + 2:
            continue
        U, S, V = N.T @ projection.efficient_score[columns], N.T @ S @ N, N.T @ V @ N
        dof = float(n_stars - q)
        if meat == "robust":
            T = float(U @ np.linalg.solve(V, U))
            p = float(stats.beta.sf(min(T / n_stars, 1.0), q / 2, dof / 2))
        else:
            dof, scale = _scale(projection, float(U @ np.linalg.solve(S, U)), q)
            V = V * scale
            T = float(U @ np.linalg.solve(V, U))
            p = float(stats.f.sf(T / q, q, dof))
        square = np.repeat(projection.functions.mean_square[family.functions], 2)
        Q = (N.T * np.tile(square, len(chips)) / len(chips)) @ N
        inverse = np.linalg.inv(S)
        step = inverse @ U
        noise2 = float(np.trace(Q @ inverse @ V @ inverse))
        yield family.name, _Part(T, p, q, dof, float(step @ Q @ step), noise2)


def _robust_meats(
    projection: Projection, blocks: Sequence[Block], which: Sequence[Int]
) -> list[Float]:
    """Covariance of the scores of each family, from those of single stars."""
    sample = projection.sample
    edges = np.cumsum([0, *map(len, which)])
    every = np.concatenate(which)
    n_stars = int(sample.star.max()) + 1
    single = n_stars == len(sample)
    of_star = np.zeros((0 if single else n_stars, len(every)))
    meats = [np.zeros((len(columns), len(columns))) for columns in which]

    def add(psi: Float) -> None:
        for k, meat in enumerate(meats):
            part = psi[:, edges[k] : edges[k + 1]]
            meat += part.T @ part

    all_chips = len(blocks) == len(sample.blocks)
    seen = np.zeros((len(every), len(every)))
    for block in blocks:
        coefficients = projection.regressor_map(block, every)
        F = projection.functions.at(block.rows)
        psi = projection.star_scores(F, block, coefficients)
        if single:
            add(psi)
        else:
            np.add.at(of_star, sample.star[block.rows], psi)
        if not all_chips:
            weighted = projection.weighted(F, block, coefficients)
            seen += np.einsum("aln,alm->nm", coefficients, weighted, optimize=True)
    if not single:
        add(of_star)
    for k, columns in enumerate(which):
        if all_chips:
            meats[k] += projection.prior_meat(columns)
        else:  # what other chips and priors say, through the frames: little
            part = slice(edges[k], edges[k + 1])
            others = projection.efficient_information(columns) - seen[part, part]
            meats[k] += projection.score_ratio * others
    return meats


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
