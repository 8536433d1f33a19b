"""Tails and quantiles are those of scipy.stats, far out in the tails too."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.utils import distributions as own

DOF = np.array([0.3, 1.0, 2.0, 7.0, 60.0, 4000.0])[:, None]
P = np.array([1e-200, 1e-30, 1e-8, 1e-4, 0.01, 0.3, 0.5, 0.9, 0.999])
X = np.array([-1.0, 0.0, 1e-6, 0.2, 1.0, 3.0, 9.0, 40.0, 700.0, 1e4])
Z = np.concatenate([-X, X])


def same(found, true):
    np.testing.assert_allclose(found, true, rtol=1e-10, atol=1e-290)


@pytest.mark.parametrize(
    ("found", "true", "values"),
    [
        (own.norm_sf, stats.norm.sf, Z),
        (own.norm_isf, stats.norm.isf, P),
    ],
)
def test_normal(found, true, values):
    same(found(values), true(values))


@pytest.mark.parametrize(
    ("found", "true", "values"),
    [
        (own.chi2_sf, stats.chi2.sf, X),
        (own.chi2_cdf, stats.chi2.cdf, X),
        (own.chi2_isf, stats.chi2.isf, P),
        (own.chi2_ppf, stats.chi2.ppf, P[3:]),
        (own.gamma_sf, stats.gamma.sf, X),
        (own.gamma_cdf, stats.gamma.cdf, X),
        (own.t_sf, stats.t.sf, Z),
        (own.t_ppf, stats.t.ppf, P[3:]),
    ],
)
def test_of_one_number(found, true, values):
    same(found(values, DOF), true(values, DOF))


@pytest.mark.parametrize("more", [1.0, 3.0, 40.0])
def test_f(more):
    same(own.f_sf(X, more, DOF), stats.f.sf(X, more, DOF))
    # back again: quantiles of scipy.stats are of 1 - p, and those of small p infinite
    limits = own.f_isf(P[2:], more, DOF[1:])
    same(stats.f.sf(limits, more, DOF[1:]), np.broadcast_to(P[2:], limits.shape))


@pytest.mark.parametrize("b", [0.5, 3.0, 800.0])
def test_beta(b):
    same(own.beta_sf(np.linspace(0, 1, 9), DOF, b), stats.beta.sf(np.linspace(0, 1, 9), DOF, b))
    same(own.beta_ppf(P[3:], DOF[1:], b), stats.beta.ppf(P[3:], DOF[1:], b))
    same([own.beta_std(float(a), b) for a in DOF[:, 0]], stats.beta.std(DOF[:, 0], b))


@pytest.mark.parametrize("n", [1, 7, 3000])
def test_binomial(n):
    for each in (0.01, 0.1, 0.5):
        np.testing.assert_array_equal(
            own.binom_ppf([0.005, 0.3, 0.995], n, each),
            stats.binom.ppf([0.005, 0.3, 0.995], n, each),
        )


def test_without_degrees_of_freedom_nothing_is_known():
    assert np.isnan(own.chi2_sf([0.0, 3.0], [0, -1])).all()
    assert np.isnan([own.chi2_cdf(1.0, 0), own.chi2_isf(0.1, 0), own.chi2_ppf(0.1, 0)]).all()
    assert np.isnan([own.f_sf(1.0, 0, 3), own.f_sf(1.0, 3, 0), own.t_sf(1.0, 0)]).all()
