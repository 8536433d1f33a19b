"""The skew as a function of linear terms against the skew as a parameter of its own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares

from bayesdist.infer import fit_linear
from bayesdist.infer.solution.geometry import skew_of
from bayesdist.model import DistortionModel
from tests.reduced import only_in_full

from ..support import CHIP, SIZE, UNCLIPPED, simulated

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


def directly(matches):
    """Parameters, covariance and chi-square by scipy, the skew among the parameters."""
    start = np.zeros(6 + 2 * len(HIGHER))
    start[1:3] = 500.0
    start[4:6] = matches.u.mean(), matches.v.mean()

    def residual(p):
        u, v = as_gndstr(p, matches.x, matches.y)
        return np.concatenate(
            [(matches.u - u) / matches.sigma_u, (matches.v - v) / matches.sigma_v]
        )

    found = least_squares(
        residual, start, "3-point", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    return found.x, np.linalg.inv(found.jac.T @ found.jac), 2 * found.cost


@pytest.fixture(scope="module")
def data():
    model = DistortionModel(ORDER, (CHIP,))
    rng = np.random.default_rng(7)
    p = np.concatenate([[0.3, 500.0, 505.0, TRUE_SKEW, 480.0, 420.0], rng.normal(size=14)])
    x, y = (0.5 + n * rng.uniform(size=500) for n in SIZE)
    positions = as_gndstr(p, x, y).T
    K, design = model.n_terms, model.basis().evaluate(x, y)
    theta = np.linalg.lstsq(design, positions)[0].T.ravel()
    assert len(theta) == K * 2
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


@pytest.mark.slow
@only_in_full("the free skew is compared with a direct fit")
def test_where_the_axes_are_perpendicular_the_significance_is_normal():
    model = DistortionModel(2, (CHIP,))
    theta = np.zeros(model.n_params)
    for axis in (0, 1):
        part = model.coefficient_slice(None, axis)
        theta[part][[0, 1 + axis]] = SIZE[axis] / 2
    found = []
    for seed in range(200):
        _, matches, _ = simulated(1000 + seed, 60, theta=theta, sigma=0.1)
        found.append(skew_of(fit_linear(matches, model, **UNCLIPPED)).significance)
    assert stats.kstest(found, stats.norm.cdf).pvalue > 1e-3
