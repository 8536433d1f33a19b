"""Polynomials by their coefficients: values, extrema, and names in the formats that own them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from bayesdist.model import polynomial_terms
from bayesdist.products.common.coefficients import (
    evaluate,
    largest_magnitude,
    sip_keyword,
    sip_powers,
)


def test_value_is_the_sum_of_its_terms() -> None:
    rng = np.random.default_rng(2)
    coefficients = {t: rng.normal() for t in polynomial_terms(4)}
    x, y = rng.uniform(-2, 2, (2, 50))
    direct = sum(c * x**i * y**j for (i, j), c in coefficients.items())
    assert_allclose(evaluate(coefficients, x, y), direct, rtol=1e-12, atol=1e-12)
    low = sum(c * x**i * y**j for (i, j), c in coefficients.items() if i + j <= 2)
    assert_allclose(evaluate(coefficients, x, y, order=2), low, rtol=1e-12, atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), order=st.integers(1, 7))
def test_largest_magnitude_is_that_of_every_pixel(seed: int, order: int) -> None:
    rng = np.random.default_rng(seed)
    nx, ny = 211, 157
    ref = rng.uniform(0, nx), rng.uniform(0, ny)
    coefficients = {(i, j): rng.normal() * 60.0 ** -(i + j) for i, j in polynomial_terms(order)}
    u, v = np.meshgrid(np.arange(1, nx + 1) - ref[0], np.arange(1, ny + 1) - ref[1])
    brute = np.abs(evaluate(coefficients, u, v)).max()
    found = largest_magnitude(coefficients, (1 - ref[0], nx - ref[0]), (1 - ref[1], ny - ref[1]))
    # never under a pixel's value, and above the best pixel by no more than the curvature allows
    assert brute * (1 - 1e-12) <= found <= brute * 1.002


def test_largest_magnitude_finds_an_interior_maximum_between_samples() -> None:
    # 1 - ((x - a)/s)^2 - ((y - b)/s)^2 has its maximum, 1, at (a, b)
    a, b, s = 17.34567, -21.98765, 90.0
    coefficients = {
        (0, 0): 1 - (a**2 + b**2) / s**2, (1, 0): 2 * a / s**2, (0, 1): 2 * b / s**2,
        (2, 0): -1 / s**2, (0, 2): -1 / s**2,
    }  # fmt: skip
    found = largest_magnitude(coefficients, (-60.0, 60.0), (-60.0, 60.0))
    assert found == pytest.approx(1.0, abs=1e-9)


def test_nothing_has_no_magnitude() -> None:
    assert largest_magnitude({}, (0, 10), (0, 10)) == 0.0
    assert largest_magnitude({(2, 0): 0.0}, (0, 10), (0, 10)) == 0.0


# -- names: the order of indices ----------------------------------------------------------------


@pytest.mark.parametrize(("i", "j"), polynomial_terms(9))
def test_names_and_powers_are_inverse_to_one_another(i: int, j: int) -> None:
    assert sip_powers(sip_keyword("BP", i, j)) == ("BP", i, j)


@pytest.mark.parametrize("name", ["CX12", "CX1", "CZ11", "A_1", "XREF", "AP_ORDER", "A_10_0"])
def test_other_names_are_no_coefficients(name: str) -> None:
    assert sip_powers(name) is None
