"""Legendre products against numpy's own Legendre series, and their two forms against each other."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import legendre, polynomial

from bayesdist.errors import InputError
from bayesdist.model import PolynomialBasis, polynomial_terms

ORDERS = range(1, 13)
SIZE, REFERENCE = (4096.0, 2048.0), (2048.0, 1024.0)  # ACS/WFC


def basis_of(order: int) -> PolynomialBasis:
    return PolynomialBasis(order, SIZE, REFERENCE)


def pixels(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    return rng.uniform(0.5, SIZE[0] + 0.5, n), rng.uniform(0.5, SIZE[1] + 0.5, n)


def as_grid(terms, coef) -> np.ndarray:
    """Coefficients as the square array c[i, j] that numpy's val2d functions take."""
    order = max(i + j for i, j in terms)
    out = np.zeros((order + 1, order + 1))
    for (i, j), value in zip(terms, coef, strict=True):
        out[i, j] = value
    return out


def test_terms_are_numbered_as_in_isr_2015_06():
    # Equations 1 and 2: A1 + A2 x + A3 y + A4 x^2 + A5 xy + A6 y^2 + A7 x^3 + ... + A21 y^5
    assert polynomial_terms(2) == ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    fifth = polynomial_terms(5)
    assert len(fifth) == 21
    assert fifth[6] == (3, 0) and fifth[-1] == (0, 5)


@pytest.mark.parametrize("order", ORDERS)
def test_terms_are_all_powers_up_to_the_order_once(order):
    basis = basis_of(order)
    every = {(i, j) for i in range(13) for j in range(13) if i + j <= order}
    assert len(basis.terms) == len(every) == basis.n_terms
    assert set(basis.terms) == every


def test_scaled_is_one_at_the_outer_edges_of_the_edge_pixels():
    basis = basis_of(3)
    X, Y = basis.scaled([0.5, 2048.5, 4096.5], [0.5, 1024.5, 2048.5])
    np.testing.assert_array_equal(X, [-1, 0, 1])
    np.testing.assert_array_equal(Y, [-1, 0, 1])


@pytest.mark.parametrize("order", ORDERS)
def test_evaluate_is_numpys_legendre_series(order):
    rng = np.random.default_rng(order)
    basis = basis_of(order)
    x, y = pixels(rng, 50)
    coef = rng.standard_normal(basis.n_terms)
    X, Y = (x - 2048.5) / 2048, (y - 1024.5) / 1024  # centre and half size, written out
    expected = legendre.legval2d(X, Y, as_grid(basis.terms, coef))
    np.testing.assert_allclose(basis.evaluate(x, y) @ coef, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("order", ORDERS)
def test_gradient_is_that_of_the_monomials(order):
    """d/dx sum m_ij x^i y^j = sum i m_ij x^(i-1) y^j, in the form without Legendre polynomials."""
    rng = np.random.default_rng(order)
    basis = basis_of(order)
    x, y = pixels(rng, 50)
    coef = rng.standard_normal(basis.n_terms)
    grid = as_grid(basis.terms, basis.to_monomials(coef))
    dx, dy = x - REFERENCE[0], y - REFERENCE[1]
    for axis, values in enumerate(basis.gradient(x, y)):
        expected = polynomial.polyval2d(dx, dy, polynomial.polyder(grid, axis=axis))
        np.testing.assert_allclose(values @ coef, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("reference", [REFERENCE, (1.0, 2000.0)])
def test_monomial_form_has_the_same_values(order, reference):
    rng = np.random.default_rng(order)
    basis = PolynomialBasis(order, SIZE, reference)
    x, y = pixels(rng, 200)
    coef = rng.standard_normal((3, basis.n_terms))
    values = coef @ basis.evaluate(x, y).T
    dx, dy = x - reference[0], y - reference[1]
    # the power coefficients of P_n add up to (1 + sqrt 2)^n at most: so much is rounded on the way
    rounding = 1e-13 + 1e-16 * (1 + np.sqrt(2)) ** order
    for row, monomial in zip(values, basis.to_monomials(coef), strict=True):
        powers = polynomial.polyval2d(dx, dy, as_grid(basis.terms, monomial))
        # a reference pixel in the corner makes the monomials cancel: digits are lost there
        scale = np.abs(monomial) @ np.abs([dx**i * dy**j for i, j in basis.terms])
        np.testing.assert_array_less(np.abs(powers - row), 1e-14 * scale + rounding)


@pytest.mark.parametrize("order", ORDERS)
def test_scaled_powers_have_the_same_values(order):
    rng = np.random.default_rng(order)
    basis = basis_of(order)
    X, Y = rng.uniform(-1, 1, (2, 100))
    coef = rng.standard_normal(basis.n_terms)
    powers = basis.to_scaled_powers(coef)
    np.testing.assert_allclose(
        polynomial.polyval2d(X, Y, as_grid(basis.terms, powers)),
        legendre.legval2d(X, Y, as_grid(basis.terms, coef)),
        rtol=0,
        atol=1e-11,
    )


@pytest.mark.parametrize("order", ORDERS)
def test_from_monomials_is_the_inverse(order):
    rng = np.random.default_rng(order)
    basis = basis_of(order)
    coef = rng.standard_normal((4, basis.n_terms))
    np.testing.assert_allclose(basis.from_monomials(basis.to_monomials(coef)), coef, atol=1e-10)
    # and a monomial given by itself comes back as that polynomial
    x, y = pixels(rng, 20)
    for k, (i, j) in enumerate(basis.terms):
        unit = np.zeros(basis.n_terms)
        unit[k] = 2048.0**-i * 1024.0**-j
        expected = ((x - 2048) / 2048) ** i * ((y - 1024) / 1024) ** j
        np.testing.assert_allclose(
            basis.evaluate(x, y) @ basis.from_monomials(unit), expected, atol=1e-12
        )


@pytest.mark.parametrize("order", [1, 4, 9, 12])
def test_covariance_of_monomials_gives_the_same_variance_of_positions(order):
    """The variance of the polynomial's value does not depend on the form it is written in."""
    rng = np.random.default_rng(order)
    basis = basis_of(order)
    root = rng.standard_normal((basis.n_terms, basis.n_terms))
    cov = root @ root.T
    coef = rng.standard_normal(basis.n_terms)
    monomial, moved = basis.to_monomials(coef, cov)
    np.testing.assert_array_equal(monomial, basis.to_monomials(coef))
    x, y = pixels(rng, 30)
    legendre_rows = basis.evaluate(x, y)
    power_rows = np.array([(x - 2048) ** i * (y - 1024) ** j for i, j in basis.terms]).T
    variance = np.einsum("nk,kl,nl->n", legendre_rows, cov, legendre_rows)
    np.testing.assert_allclose(
        np.einsum("nk,kl,nl->n", power_rows, moved, power_rows), variance, rtol=1e-9
    )


def test_condition_numbers_are_those_that_made_us_choose_legendre():
    """Raw monomials at order 5: 3e16 (beyond double precision); Legendre products: below 10."""
    basis = basis_of(5)
    x, y = (g.ravel() for g in np.meshgrid(np.arange(32.5, 4096, 64), np.arange(32.5, 2048, 64)))
    raw = np.array([x**i * y**j for i, j in basis.terms]).T
    assert np.linalg.cond(raw) > 1e16
    assert np.linalg.cond(basis.evaluate(x, y)) < 10


@pytest.mark.parametrize("order", [0, 13, -1])
def test_order_outside_1_to_12_is_refused(order):
    with pytest.raises(InputError, match=f"order is {order}.*from 1 to 12"):
        PolynomialBasis(order, SIZE, REFERENCE)


@pytest.mark.parametrize("size", [(0, 10), (10, -1)])
def test_size_must_be_positive(size):
    with pytest.raises(InputError, match=r"detector\.size"):
        PolynomialBasis(2, size, REFERENCE)
