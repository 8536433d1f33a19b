"""Covariance by the scatter of the stars, against the exact one of least squares."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.data import Matches
from bayesdist.diagnose.correlated.information import Information, SquaredScores, cell_sums
from bayesdist.infer import GaussianPriors, LinearFit
from bayesdist.infer.solution.solution import likelihood_of
from bayesdist.infer.stars.stars import prepare
from bayesdist.model.grid import grid_pixels, mesh
from tests.diagnose.correlated.skies import SIGMA, SIZE, Map, matched

SEEDS = 10
GRID = mesh(*grid_pixels((SIZE, SIZE), (9, 9)))


def alike(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.full((len(x), 2), SIGMA)


def worse_corner(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    corner = (x > 0.75 * SIZE) & (y > 0.75 * SIZE)
    return SIGMA * np.where(corner, 5.0, 1.0)[:, None] * np.ones(2)


def worse_axis(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return SIGMA * np.array([1.0, 2.0]) * np.ones((len(x), 1))


def squared(fit: LinearFit, table: Matches) -> SquaredScores:
    """Squares of one data set."""
    stars, _ = prepare(fit.model, table)
    sums, mean = cell_sums(stars, likelihood_of(fit), 64), np.asarray(fit.mean)
    return Information(fit.model, mean, sums, GaussianPriors.none(fit.model)).squared_scores()


def exact(fit: LinearFit, table: Matches, noise: Map) -> np.ndarray:
    """Covariance (D, D) of a least-squares fit of stars with these errors."""
    J = fit.model.jacobian(fit.mean, table.x, table.y).reshape(-1, len(fit.mean))
    inverse = np.linalg.inv(J.T @ J)
    return inverse @ ((J.T * noise(table.x, table.y).ravel() ** 2) @ J) @ inverse


def variances(fit: LinearFit, cov: np.ndarray) -> np.ndarray:
    """Variances (P, 2) of positions on a grid."""
    phi = fit.model.basis(1).evaluate(*GRID)
    K = phi.shape[1]
    parts = cov[:K, :K], cov[K:, K:]
    return np.stack([np.einsum("nk,kl,nl->n", phi, part, phi) for part in parts], axis=1)


@pytest.mark.parametrize(("n", "order"), [(400, 7), (100, 3)])
def test_stars_that_are_alike_have_the_covariance_of_the_likelihood(n, order):
    """The jackknife alone is too wide, by the stars of high leverage at the edges."""
    ratios, weights = [], []
    for seed in range(SEEDS):
        fit, table, _ = matched(n, np.random.default_rng([5, seed]), order=order)
        squares = squared(fit, table)
        unit = variances(fit, exact(fit, table, alike)).mean()
        stated = squares.by_evidence, squares.sandwich()
        ratios.append([variances(fit, cov).mean() / unit for cov in stated])
        weights.append(squares.weight)
    by_evidence, jackknife = np.sqrt(np.mean(ratios, axis=0))
    # the scale is known to 1 / sqrt(2 (2 n - D)), 0.05 in a data set of 100 stars
    assert 0.9 < by_evidence < 1.1
    assert jackknife > 1.05
    assert np.mean(weights) < 0.4


@pytest.mark.parametrize("noise", [worse_corner, worse_axis])
def test_stars_that_differ_have_the_covariance_of_the_sandwich(noise):
    ratios, weights = [], []
    for seed in range(SEEDS):
        fit, table, _ = matched(1500, np.random.default_rng([5, seed]), noise=noise)
        squares = squared(fit, table)
        stated = variances(fit, squares.by_evidence).mean()
        ratios.append(stated / variances(fit, exact(fit, table, noise)).mean())
        weights.append(squares.weight)
    assert np.sqrt(np.mean(ratios)) == pytest.approx(1.0, abs=0.1)
    assert np.min(weights) > 0.9


def test_few_stars_that_differ_are_covered():
    """100 stars, of which some are five times worse: little evidence, and no harm from that."""
    pulls = []
    for seed in range(4 * SEEDS):
        rng = np.random.default_rng([6, seed])
        fit, table, true = matched(100, rng, noise=worse_corner)
        error = fit.model.predict(fit.mean, *GRID) - true(*GRID)
        pulls.append(np.abs(error) / np.sqrt(variances(fit, squared(fit, table).by_evidence)))
    # 40 data sets of 20 parameters, whose positions are not independent
    assert np.mean(np.array(pulls) < 1.0) > 0.6
    assert np.mean(np.array(pulls) < 1.96) > 0.9
