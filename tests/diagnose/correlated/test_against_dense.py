"""Information, sandwich and conditional posteriors against algebra with all stars explicit."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.diagnose.correlated.information import Information, cell_sums
from bayesdist.diagnose.correlated.priors import StructureFunctions
from bayesdist.diagnose.correlated.result import ChipStructure, Discrepancy
from bayesdist.diagnose.correlated.structure import structure_posterior
from bayesdist.infer import GaussianPriors
from bayesdist.infer.solution.solution import likelihood_of
from bayesdist.infer.stars.stars import prepare
from tests.diagnose.correlated.skies import SIGMA, matched

SIDE = 64


@pytest.fixture(scope="module")
def lone():
    """Stars of which no two are in one cell, so that sums over cells are exact."""
    rng = np.random.default_rng(4)
    fit, table, _ = matched(1200, rng)
    cell = (np.minimum((table.x - 0.5) / 2048 * SIDE, SIDE - 1)).astype(int)
    cell = cell + SIDE * np.minimum((table.y - 0.5) / 2048 * SIDE, SIDE - 1).astype(int)
    rows = np.sort(np.unique(cell, return_index=True)[1])[:150]
    table = table.select(rows)
    stars, _ = prepare(fit.model, table)
    sums = cell_sums(stars, likelihood_of(fit), SIDE)
    information = Information(fit.model, np.asarray(fit.mean), sums, GaussianPriors.none(fit.model))
    J = fit.model.jacobian(fit.mean, table.x, table.y).reshape(-1, fit.model.n_params)
    r = np.column_stack([table.u, table.v]) - fit.model.predict(fit.mean, table.x, table.y)
    return information, J, r.ravel()


def test_the_information_is_that_of_all_stars(lone):
    information, J, r = lone
    np.testing.assert_allclose(information.precision, J.T @ J / SIGMA**2, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(information.score, J.T @ r / SIGMA**2, rtol=1e-7, atol=1e-5)


def test_the_sandwich_is_hc3_and_its_weight_twice_that_of_ledoit_and_wolf(lone):
    """With the hat matrix and every star's product of scores written out."""
    information, J, r = lone
    inverse = np.linalg.inv(J.T @ J)
    hat = np.einsum("nd,de,ne->n", J, inverse, J)
    pairs = J.reshape(-1, 2, J.shape[1])
    root = np.linalg.cholesky(inverse)

    def products(power):
        """Product (D, D) of the scores of each star, where the parameters have unit covariance."""
        scores = np.einsum("nad,na->nd", pairs, (r / (1 - hat) ** power).reshape(-1, 2)) @ root
        return scores[:, :, None] * scores[:, None, :]

    # both axes of a star have one membership: products of its two scores are in as well
    jackknife, unbiased = products(1.0), products(0.5)
    expected = root @ jackknife.sum(axis=0) @ root.T
    squares = information.squared_scores()
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        squares.sandwich() / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-8
    )
    of_each = np.einsum("nad,nae->nde", pairs @ root, pairs @ root)
    factor = np.trace(unbiased.sum(axis=0)) / np.trace(of_each.sum(axis=0))
    assert squares.scale == pytest.approx(factor / SIGMA**2, rel=1e-8)
    left = unbiased - factor * of_each
    weight = np.clip(2 * (1 - np.sum(left**2) / np.sum(left.sum(axis=0) ** 2)), 0.0, 1.0)
    assert squares.weight == pytest.approx(weight, abs=1e-8)
    mixed = weight * jackknife.sum(axis=0) + (1 - weight) * factor * np.eye(len(root))
    np.testing.assert_allclose(
        squares.by_evidence / np.outer(scale, scale),
        root @ mixed @ root.T / np.outer(scale, scale),
        atol=1e-7,
    )


def test_sines_are_orthogonal_to_the_polynomials_over_the_chip():
    functions = StructureFunctions(3, (2048.0, 1024.0), 10)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    X, Y = (z.ravel() for z in np.meshgrid(nodes, nodes))
    w = np.outer(weights, weights).ravel() / 4
    B = functions.evaluate(X, Y)
    for i in range(4):
        for j in range(4 - i):
            p = np.polynomial.legendre.Legendre.basis(i)(X)
            p = p * np.polynomial.legendre.Legendre.basis(j)(Y)
            assert np.abs(B.T @ (w * p)).max() < 1e-12


def test_a_fit_follows_structure_of_the_catalogue():
    """Least squares of the field itself, low orders included, which the functions leave out."""
    rng = np.random.default_rng(6)
    fit, table, _ = matched(800, rng)
    model, n = fit.model, 5
    chip = model.chips[0]
    functions = StructureFunctions(model.order, chip.size, 8)
    waves = functions.finer_waves(rng)
    z = rng.standard_normal((n, 2, functions.n_known + 2 * len(waves)))
    structure = ChipStructure(functions, waves, z)
    X, Y = model.basis().scaled(table.x, table.y)
    phi, values = model.basis().evaluate_scaled(X, Y), structure.evaluate(X, Y)

    def fitted(field):
        """Parameters (n, D) of least squares of fields (n, 2, N)."""
        out = np.zeros((n, model.n_params))
        for a in (0, 1):
            columns = model.coefficient_slice(chip.number, a)
            out[:, columns] = np.linalg.lstsq(phi, field[:, a].T)[0].T
        return out

    T, S = functions.n_terms, functions.n_sines
    i, j = functions._waves.T - 1
    raw = values.copy()
    raw[:, T : T + S] = functions._along(0, X)[:, i] * functions._along(1, Y)[:, j]
    zero = np.zeros((model.n_params, model.n_params))
    followed = -fitted(z @ values.T)
    found = Discrepancy(
        model, fit.mean, zero, zero, {chip.number: structure}, followed, linear=None
    )
    np.testing.assert_allclose(found.structure_of_catalogue(), -fitted(z @ raw.T), atol=1e-9)


def test_the_sines_have_the_covariance_of_a_matern_field():
    """In the middle of a large chip, at lengths that the sines resolve."""
    functions = StructureFunctions(1, (2048.0, 2048.0), 20)
    length, lag = 0.35, np.array([0.0, 0.1, 0.25, 0.5])
    # the sines themselves: what polynomials take is no part of a stationary field
    raw = functions._along(0, lag - 0.25), functions._along(1, np.zeros(4))
    i, j = functions._waves.T - 1
    whole = raw[0][:, i] * raw[1][:, j]
    covariance = whole @ np.diag(functions.spectrum(length)) @ whole[0]
    t = np.sqrt(3) * lag / length
    np.testing.assert_allclose(covariance, (1 + t) * np.exp(-t), atol=0.06)


def test_conditional_means_are_those_of_dense_algebra():
    rng = np.random.default_rng(0)
    functions = StructureFunctions(2, (512.0, 512.0), 6)
    m = functions.n_known
    roots = rng.normal(0, 30, (2, m, m + 5))
    S = [root @ root.T for root in roots]
    s = [rng.normal(0, 40, m) @ np.linalg.cholesky(one).T * 0.02 for one in S]
    posterior = structure_posterior(
        [[functions]] * 2, S, s, noise=0.02, higher_order=1e-3, structure=1e-3
    )
    point = posterior.points[len(posterior.points) // 2]
    amplitude = 3e-3
    T, decline = functions.n_terms, functions.decline()
    for a, part in enumerate(point.parts):
        variance = np.concatenate(
            [
                (amplitude * decline) ** 2,
                point.amplitudes[a] ** 2 * functions.spectrum(point.length),
            ]
        )
        precision = S[a] + np.diag(1 / variance)
        mean, cov = np.linalg.solve(precision, s[a]), np.linalg.inv(precision)
        terms = part.draws(np.full(40_000, amplitude), rng)
        sines = part.field.draws(terms, np.tile(part.variance, (len(terms), 1)), rng)
        drawn = np.concatenate([terms * decline, sines], axis=1)
        pull = (drawn.mean(axis=0) - mean) / np.sqrt(np.diag(cov) / len(drawn))
        assert np.abs(pull).max() < 5.0
        ratio = drawn[:, :T].var(axis=0) / np.diag(cov)[:T]
        np.testing.assert_allclose(ratio, 1.0, atol=0.05)


def test_draws_do_not_follow_rounding():
    """Eigenvectors of one eigenvalue turn at the last digit of a matrix; the draws stay."""
    rng = np.random.default_rng(1)
    functions = StructureFunctions(2, (512.0, 512.0), 6)
    m, T, decline = functions.n_known, functions.n_terms, functions.decline()
    S = np.diag(np.concatenate([1e6 / decline**2, np.full(m - T, 1e6)]))
    score = rng.normal(0, 1e3, m)
    drawn = []
    for rounding in (0.0, 1e-13):
        noise = np.random.default_rng(2).normal(0, rounding, (m, m))
        root = np.sqrt(np.diag(S))
        moved = S + np.outer(root, root) * (noise + noise.T)
        found = structure_posterior(
            [[functions]] * 2,
            [moved] * 2,
            [score] * 2,
            noise=0.02,
            higher_order=1e-3,
            structure=1e-3,
        )
        drawn.append(np.stack(found.draws(200, np.random.default_rng(3)), axis=1))
    np.testing.assert_allclose(drawn[1], drawn[0], rtol=0, atol=1e-9 * np.abs(drawn[0]).max())
