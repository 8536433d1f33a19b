"""The cube-root coordinates: their definition, derivatives and inverse."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import expit

from bayesdist.infer.density.laplace import from_cube_root, inside, to_cube_root

from ..support import numerical_gradient

CASES = [(), ("f",), ("s_out",), ("f", "s_out")]


def points(names) -> np.ndarray:
    """Sampled coordinates: logit f from 1e-9 to 0.999, log s_out over twelve decades."""
    rng = np.random.default_rng(1)
    ranges = {"f": (-20, 7), "s_out": (-14, 14)}
    return np.array([rng.uniform(*ranges[k], 50) for k in names]).reshape(len(names), 50).T


@pytest.mark.parametrize("names", CASES, ids=str)
def test_definition_and_inverse(names):
    h = points(names)
    z = to_cube_root(names, h)
    for k, name in enumerate(names):
        natural = expit(h[:, k]) if name == "f" else np.exp(-2 * h[:, k])
        np.testing.assert_allclose(z[:, k], np.cbrt(natural), rtol=1e-12)
    assert inside(names, z).all()
    np.testing.assert_allclose(from_cube_root(names, z)[0], h, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("names", CASES[1:3], ids=str)
def test_derivatives_by_differences(names):
    z = to_cube_root(names, points(names))
    z = z[(z[:, 0] < 0.95) | (names[0] != "f")]
    h, h1, h2, g1, g2 = (a[:, 0] for a in from_cube_root(names, z))
    for value, first, second in ((h, h1, h2), (np.log(np.abs(h1)), g1, g2)):
        pick = 0 if value is h else 1

        def at(t, pick=pick):
            out = from_cube_root(names, t[:, None])
            return out[0][:, 0] if pick == 0 else np.log(np.abs(out[1][:, 0]))

        def slope(t, pick=pick):
            return from_cube_root(names, t[:, None])[1 if pick == 0 else 3][:, 0]

        step = 1e-4 * z[:, 0] * np.where(np.array(names[0] == "f"), 1 - z[:, 0], 1)
        for function, derivative in ((at, first), (slope, second)):
            t = z[:, 0]
            numeric = (
                8 * (function(t + step) - function(t - step))
                - (function(t + 2 * step) - function(t - 2 * step))
            ) / (12 * step)
            np.testing.assert_allclose(derivative, numeric, rtol=1e-6)


def test_support():
    names = ("f", "s_out")
    z = np.array([[0.5, 2.0], [0.0, 1.0], [1.0, 1.0], [-0.1, 1.0], [0.5, 0.0], [0.5, -1.0]])
    np.testing.assert_array_equal(inside(names, z), [True] + [False] * 5)
    assert inside((), np.zeros((3, 0))).all()


def test_a_gamma_variable_is_nearly_symmetric_in_its_cube_root():
    """Wilson and Hilferty 1931: the reason for these coordinates."""
    from scipy.stats import skew

    rng = np.random.default_rng(2)
    precision = rng.gamma(5.0, size=200_000)
    z = to_cube_root(("s_out",), -0.5 * np.log(precision)[:, None])[:, 0]
    assert abs(skew(z)) < 0.05 < 0.4 < abs(skew(np.log(precision)))


def test_the_helper_of_these_tests():
    gradient = numerical_gradient(lambda p: np.sin(p[0]) * p[1], np.array([0.3, 2.0]), 1e-3)
    np.testing.assert_allclose(gradient, [2 * np.cos(0.3), np.sin(0.3)], rtol=1e-10)
