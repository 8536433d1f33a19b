"""The skew as a condition on linear terms against the skew as a parameter of its own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares

from bayesdist.errors import InputError
from bayesdist.infer import fit_linear
from bayesdist.infer.skew import fit_with_skew, skew_of
from bayesdist.model import DistortionModel

from .support import CHIP, SIZE, UNCLIPPED, simulated

ORDER = 3
HIGHER = [(n - j, j) for n in range(2, ORDER + 1) for j in range(n + 1)]
TRUE_SKEW = 0.004


def as_gndstr(p, x, y):
    """Turn, two scales and the skew in place of linear terms: positions (2, N).

    The image of the x axis lies at angle p[0], that of the y axis at p[0] + 90 degrees + p[3].
    """
    X, Y = ((z - r) / 500.0 for z, r in zip((x, y), CHIP.reference_pixel, strict=True))
    turn, scale_x, scale_y, skew = p[:4]
    u = p[4] + scale_x * np.cos(turn) * X - scale_y * np.sin(turn + skew) * Y
    v = p[5] + scale_x * np.sin(turn) * X + scale_y * np.cos(turn + skew) * Y
    powers = np.array([X**i * Y**j for i, j in HIGHER])
    a, b = p[6:].reshape(2, -1)
    return np.stack([u + a @ powers, v + b @ powers])


def directly(matches, *, given=None, prior=None):
    """Parameters, covariance and chi-square by scipy, the skew fitted, given or with a prior."""
    free = np.ones(6 + 2 * len(HIGHER), bool)
    free[3] = given is None
    start = np.zeros(len(free))
    start[1:3] = 500.0
    start[4:6] = matches.u.mean(), matches.v.mean()
    start[3] = given or 0.0

    def whole(q):
        p = start.copy()
        p[free] = q
        return p

    def residual(q):
        p = whole(q)
        u, v = as_gndstr(p, matches.x, matches.y)
        stars = [(matches.u - u) / matches.sigma_u, (matches.v - v) / matches.sigma_v]
        own = [] if prior is None else [[(p[3] - prior[0]) / prior[1]]]
        return np.concatenate([*stars, *own])

    found = least_squares(
        residual, start[free], "3-point", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    cov = np.linalg.inv(found.jac.T @ found.jac)
    return whole(found.x), cov, 2 * found.cost


@pytest.fixture(scope="module")
def data():
    model = DistortionModel(ORDER, (CHIP,))
    rng = np.random.default_rng(7)
    p = np.concatenate([[0.3, 500.0, 505.0, TRUE_SKEW, 480.0, 420.0], rng.normal(size=14)])
    x, y = (0.5 + n * rng.uniform(size=500) for n in SIZE)
    positions = as_gndstr(p, x, y).T
    K, design = model.n_terms, model.basis().evaluate(x, y)
    theta = np.linalg.lstsq(design, positions)[0].T.ravel()
    assert K * 2 == len(theta)
    sigma = (rng.uniform(0.05, 0.3, 500), rng.uniform(0.05, 0.3, 500))
    model, matches, _ = simulated(7, 500, order=ORDER, theta=theta, sigma=sigma)
    return theta, matches, fit_linear(matches, model, **UNCLIPPED)


def test_the_free_skew_is_that_of_the_direct_fit(data):
    _, matches, fit = data
    p, cov, chi2 = directly(matches)
    skew = skew_of(fit)
    assert skew.value == pytest.approx(p[3], abs=1e-9)
    assert skew.sigma == pytest.approx(np.sqrt(cov[3, 3]), rel=1e-5)
    assert fit.chi2 == pytest.approx(chi2, rel=1e-9)
    assert skew.significance == skew.value / skew.sigma
    assert abs(skew.value - TRUE_SKEW) < 4 * skew.sigma


@pytest.mark.parametrize("given", [0.0, 0.01, -0.2])
def test_a_given_skew_is_that_of_the_direct_fit(data, given):
    """The same positions, and their errors, and the same chi-square.  Far from it, too."""
    _, matches, fit = data
    p, cov, chi2 = directly(matches, given=given)
    held = fit_with_skew(fit, given)
    assert skew_of(held).value == pytest.approx(given, abs=1e-12)
    assert held.chi2 == pytest.approx(chi2, rel=1e-8)
    assert held.dof == fit.dof + 1
    x, y = np.array([10.0, 500.0, 990.0, 30.0]), np.array([10.0, 400.0, 780.0, 700.0])
    np.testing.assert_allclose(
        held.model.predict(held.mean, x, y), as_gndstr(p, x, y).T, atol=1e-5 * (1 + 50 * abs(given))
    )
    assert skew_of(held).sigma < 1e-6 * skew_of(fit).sigma
    if given == 0.0:  # errors of positions, where the condition is nearly linear
        step = 1e-6
        free = np.delete(np.arange(len(p)), 3)
        J = np.stack(
            [
                (as_gndstr(p + step * e, x, y) - as_gndstr(p - step * e, x, y)) / (2 * step)
                for e in np.eye(len(p))[free]
            ],
            axis=-1,
        )
        design = held.model.basis().evaluate(x, y)
        K = design.shape[1]
        for axis in (0, 1):
            part = slice(axis * K, (axis + 1) * K)
            ours = np.einsum("nk,kl,nl->n", design, held.cov[part, part], design)
            np.testing.assert_allclose(
                ours, np.einsum("nk,kl,nl->n", J[axis], cov, J[axis]), rtol=1e-4
            )


def test_a_prior_on_the_skew_is_that_of_the_direct_fit(data):
    _, matches, fit = data
    sigma = skew_of(fit).sigma
    p, cov, chi2 = directly(matches, prior=(0.0, sigma))
    held = fit_with_skew(fit, 0.0, sigma)
    assert skew_of(held).value == pytest.approx(p[3], abs=1e-10)
    assert skew_of(held).sigma == pytest.approx(np.sqrt(cov[3, 3]), rel=1e-5)
    assert held.chi2 + (p[3] / sigma) ** 2 == pytest.approx(chi2, rel=1e-9)


def test_what_the_constraint_costs_is_the_significance_squared():
    """And follows chi-square with one degree of freedom where the axes are perpendicular."""
    model = DistortionModel(2, (CHIP,))
    theta = np.zeros(model.n_params)
    for axis in (0, 1):
        part = model.coefficient_slice(None, axis)
        theta[part][[0, 1 + axis]] = SIZE[axis] / 2
    costs = []
    for seed in range(200):
        _, matches, _ = simulated(1000 + seed, 60, theta=theta, sigma=0.1)
        fit = fit_linear(matches, model, **UNCLIPPED)
        costs.append(fit_with_skew(fit).chi2 - fit.chi2)
        assert costs[-1] == pytest.approx(skew_of(fit).significance ** 2, rel=1e-3, abs=1e-6)
    assert stats.kstest(costs, stats.chi2(1).cdf).pvalue > 1e-3


def test_without_a_condition_the_axes_are_fitted_apart_and_with_it_they_are_tied(data):
    _, _, fit = data
    K = fit.model.n_terms
    assert not fit.cov[:K, K:].any()
    held = fit_with_skew(fit)
    correlation = held.cov / np.sqrt(np.outer(np.diag(held.cov), np.diag(held.cov)))
    assert np.abs(correlation[:K, K:]).max() > 0.01


def test_impossible_conditions_are_refused(data):
    fit = data[2]
    with pytest.raises(InputError, match="skew is 2"):
        fit_with_skew(fit, 2.0)
    with pytest.raises(InputError, match=r"0\.0 \+- -1"):
        fit_with_skew(fit, 0.0, -1.0)
