"""Radii of circles: the distributions of Rayleigh and Gauss at the ends, and draws in between."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, norm

from bayesdist.assess.maps import circular_error, per_axis


@pytest.mark.parametrize("p", [0.5, 0.68, 0.95, 0.99])
def test_circles_of_equal_axes_and_of_one_axis(p):
    assert circular_error(3.0, 3.0, 0.0, p) == pytest.approx(3 * np.sqrt(chi2.ppf(p, 2)), rel=1e-6)
    one = norm.ppf((1 + p) / 2)
    assert circular_error(0.0, 2.0, 0.0, p) == pytest.approx(2 * one, rel=1e-6)
    # fully correlated axes are one axis along the diagonal
    assert circular_error(1.0, 1.0, 1.0, p) == pytest.approx(np.sqrt(2) * one, rel=1e-6)
    assert circular_error(0.0, 0.0, 0.0, p) == 0.0


@pytest.mark.parametrize(("v", "rho"), [(0.03, 0.0), (0.3, 0.0), (0.8, 0.5), (0.7, -0.9)])
def test_the_circle_holds_its_probability(v, rho):
    z = np.random.default_rng(5).normal(size=(400_000, 2))
    r = np.hypot(z[:, 0], v * (rho * z[:, 0] + np.sqrt(1 - rho**2) * z[:, 1]))
    for p in (0.68, 0.95):
        found = (r < circular_error(1.0, v, rho, p)).mean()
        assert found == pytest.approx(p, abs=4 * np.sqrt(p * (1 - p) / r.size))


def test_per_axis_is_the_root_of_the_mean_variance():
    assert per_axis(3.0, 4.0) == pytest.approx(np.sqrt(12.5))
