"""Two-dimensional polynomials in products of Legendre polynomials over the detector.

Raw pixel monomials are hopelessly conditioned (3e16 at order 5); Legendre products over the
detector are nearly orthogonal for stars spread evenly.  Coefficients are converted to monomials of
pixel offsets, with their covariance, only where a product is written.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import comb
from numbers import Integral
from typing import Any, overload

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float

MAX_ORDER = 12
# Points whose basis values are held at once: 91 terms (order 12) of them are 24 MB.
BLOCK = 32768


@lru_cache
def polynomial_terms(order: int) -> tuple[tuple[int, int], ...]:
    """Powers (i, j) of x and y up to a total order.

    Sorted by total order, then by falling power of x: 1, x, y, x^2, xy, y^2, ... as Equations 1-2
    of ACS ISR 2015-06 number them.

    Parameters
    ----------
    order : int
        Total order, 0 or more.

    Returns
    -------
    tuple of (int, int)
        ``(order + 1) (order + 2) / 2`` pairs.
    """
    return tuple((n - j, j) for n in range(order + 1) for j in range(n + 1))


def polynomial_values(coefficients: Float, x: ArrayLike, y: ArrayLike) -> Float:
    """Values of the sum of coefficients[i, j] x^i y^j, at points of any shape.

    By Horner's scheme in place, without what is zero: numpy's takes eight times as long for a
    triangle of coefficients at many points.
    """
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    out = np.zeros(x.shape)
    for row in coefficients[::-1].tolist():  # at few points numpy takes longer for a row than for y
        out *= x
        while row and row[-1] == 0.0:
            row.pop()
        if not row:
            continue
        inner = row.pop()
        if row:
            inner = inner * y
            inner += row.pop()
        while row:
            inner *= y
            inner += row.pop()
        out += inner
    return out


def point_blocks(n: int) -> Iterator[slice]:
    """Slices of n points into blocks whose basis values can be held at once."""
    for start in range(0, n, BLOCK):
        yield slice(start, min(start + BLOCK, n))


def as_pair(values: Sequence[float]) -> tuple[float, float]:
    """Numbers of x and y from any sequence of two."""
    a, b = values
    return float(a), float(b)


def _legendre_derivatives(order: int) -> Float:
    """Matrix whose column i holds the Legendre coefficients of P_i'."""
    out = np.zeros((order + 1, order + 1))
    for i in range(1, order + 1):
        out[:i, i] = legendre.legder(np.eye(order + 1)[i, : i + 1])
    return out


def _converted(order: int, convert: Callable[..., Any]) -> Float:
    """Matrix whose row i holds the coefficients in another basis of the i-th function of one."""
    out = np.zeros((order + 1, order + 1))
    for i in range(order + 1):
        out[i, : i + 1] = convert(np.eye(order + 1)[i, : i + 1])
    return out


def _substitute(order: int, scale: float, shift: float) -> Float:
    """Matrix whose row i holds the power coefficients in z of (scale z + shift)^i."""
    out = np.zeros((order + 1, order + 1))
    for i in range(order + 1):
        for k in range(i + 1):
            out[i, k] = comb(i, k) * scale**k * shift ** (i - k)
    return out


def _product_matrix(terms: tuple[tuple[int, int], ...], mx: Float, my: Float) -> Float:
    """Coefficient map (new, old) of a change of basis that acts on each axis by itself."""
    i, j = np.array(terms).T
    return mx[np.ix_(i, i)].T * my[np.ix_(j, j)].T


@dataclass(frozen=True)
class PolynomialBasis:
    """Legendre products P_i(X) P_j(Y) with i + j <= order over one chip.

    X and Y run over [-1, 1] from edge to edge of the detector (pixels 0.5 to n + 0.5, FITS
    1-based).

    Parameters
    ----------
    order : int
        Total order, 1 to 12.
    size : tuple of float
        Columns and rows of the detector, in pixels.
    reference_pixel : tuple of float
        Zero point (xref, yref) of the monomial form, FITS 1-based pixels.

    Raises
    ------
    InputError
        For an order outside 1..12 or a size that is not positive.

    Examples
    --------
    >>> from bayesdist.model import PolynomialBasis
    >>> basis = PolynomialBasis(2, (1016, 1016), (508.5, 508.5))
    >>> basis.n_terms
    6
    >>> X, Y = basis.scaled([0.5, 508.5], [508.5, 1016.5])  # from edge to edge
    >>> X.tolist(), Y.tolist()
    ([-1.0, 0.0], [0.0, 1.0])
    """

    order: int
    size: tuple[float, float]
    reference_pixel: tuple[float, float]

    def __post_init__(self) -> None:
        if not isinstance(self.order, Integral) or not 1 <= self.order <= MAX_ORDER:
            raise InputError(
                f"polynomial order is {self.order!r}",
                where="model.order",
                do=f"choose an order from 1 to {MAX_ORDER}",
            )
        if min(self.size) <= 0:
            raise InputError(
                f"detector size is {tuple(self.size)}",
                where="detector.size",
                do="give positive numbers of columns and rows",
            )

    @property
    def terms(self) -> tuple[tuple[int, int], ...]:
        """Powers (i, j) in the order of the coefficients."""
        return polynomial_terms(self.order)

    @property
    def n_terms(self) -> int:
        """Number of terms of one axis."""
        return (self.order + 1) * (self.order + 2) // 2

    @property
    def mean_squares(self) -> Float:
        """Mean square (n_terms,) of each basis function over the detector."""
        i, j = np.array(self.terms).T
        return 1.0 / ((2 * i + 1) * (2 * j + 1))

    @property
    def half_size(self) -> tuple[float, float]:
        """Half the detector's extent on x and y: the length of X = 1, in pixels."""
        return self.size[0] / 2, self.size[1] / 2

    def scaled(self, x: ArrayLike, y: ArrayLike) -> tuple[Float, Float]:
        """Pixels to [-1, 1].

        Parameters
        ----------
        x, y : array_like
            FITS 1-based pixels.

        Returns
        -------
        X, Y : ndarray
            Same shapes; -1 and 1 at the outer edges of the first and last pixel.
        """
        nx, ny = self.size
        return (
            (2.0 * np.asarray(x, float) - (nx + 1.0)) / nx,
            (2.0 * np.asarray(y, float) - (ny + 1.0)) / ny,
        )

    def evaluate(self, x: ArrayLike, y: ArrayLike) -> Float:
        """Values of all basis functions.

        Parameters
        ----------
        x, y : array_like, shape (N,)
            FITS 1-based pixels.

        Returns
        -------
        ndarray, shape (N, n_terms)
        """
        return self.evaluate_scaled(*self.scaled(x, y))

    def evaluate_scaled(self, X: ArrayLike, Y: ArrayLike) -> Float:
        """Values of all basis functions at positions that `scaled` has brought to [-1, 1].

        Parameters
        ----------
        X, Y : array_like, shape (...)

        Returns
        -------
        ndarray, shape (..., n_terms)
        """
        i, j = np.array(self.terms).T
        px: Float = legendre.legvander(np.asarray(X, float), self.order)
        py: Float = legendre.legvander(np.asarray(Y, float), self.order)
        return px[..., i] * py[..., j]

    @cached_property
    def derivatives(self) -> tuple[Float, Float]:
        """Matrices (n_terms, n_terms) from a polynomial's coefficients to its derivatives'.

        By x and by y, per pixel: the derivative of a polynomial is one of lower order in the same
        basis.
        """
        of_one = _legendre_derivatives(self.order)
        i, j = np.array(self.terms).T
        half_x, half_y = self.half_size
        return (
            of_one[np.ix_(i, i)] * (j[:, None] == j) / half_x,
            of_one[np.ix_(j, j)] * (i[:, None] == i) / half_y,
        )

    def gradient(self, x: ArrayLike, y: ArrayLike) -> tuple[Float, Float]:
        """Derivatives of all basis functions by the pixel.

        Parameters
        ----------
        x, y : array_like, shape (N,)
            FITS 1-based pixels.

        Returns
        -------
        d_dx, d_dy : ndarray, shape (N, n_terms)
            Per pixel.
        """
        values = self.evaluate(x, y)
        by_x, by_y = self.derivatives
        return values @ by_x, values @ by_y

    @cached_property
    def _to_scaled_powers(self) -> Float:
        to_powers = _converted(self.order, legendre.leg2poly)
        return _product_matrix(self.terms, to_powers, to_powers)

    @cached_property
    def monomial_matrix(self) -> Float:
        """Matrix (n_terms, n_terms) from Legendre to monomial coefficients of pixel offsets."""
        to_powers = _converted(self.order, legendre.leg2poly)
        axes = [
            # X = (x' - c) / s with the centre c measured from the reference pixel
            to_powers @ _substitute(self.order, 2.0 / n, -((n + 1.0) - 2.0 * ref) / n)
            for n, ref in zip(self.size, self.reference_pixel, strict=True)
        ]
        return _product_matrix(self.terms, *axes)

    @cached_property
    def _inverse_monomial_matrix(self) -> Float:
        to_legendre = _converted(self.order, legendre.poly2leg)
        axes = [
            _substitute(self.order, n / 2.0, ((n + 1.0) - 2.0 * ref) / 2.0) @ to_legendre
            for n, ref in zip(self.size, self.reference_pixel, strict=True)
        ]
        return _product_matrix(self.terms, *axes)

    def to_scaled_powers(self, coef: ArrayLike) -> Float:
        """Coefficients of X^i Y^j: the form that Horner's rule wants.

        Parameters
        ----------
        coef : array_like, shape (..., n_terms)
            Legendre coefficients.

        Returns
        -------
        ndarray, same shape
        """
        return np.asarray(coef, float) @ self._to_scaled_powers.T

    @overload
    def to_monomials(self, coef: ArrayLike) -> Float: ...
    @overload
    def to_monomials(self, coef: ArrayLike, cov: ArrayLike) -> tuple[Float, Float]: ...
    def to_monomials(
        self, coef: ArrayLike, cov: ArrayLike | None = None
    ) -> Float | tuple[Float, Float]:
        """Coefficients of (x - xref)^i (y - yref)^j, with their covariance.

        Parameters
        ----------
        coef : array_like, shape (..., n_terms)
            Legendre coefficients of one axis, in the unit of u, v.
        cov : array_like, shape (n_terms, n_terms), optional
            Their covariance.

        Returns
        -------
        ndarray, same shape as `coef`; with `cov`, a pair with the covariance of the result
            In the unit of u, v per pixel^(i + j).
        """
        m = self.monomial_matrix
        out = np.asarray(coef, float) @ m.T
        if cov is None:
            return out
        return out, m @ np.asarray(cov, float) @ m.T

    def from_monomials(self, coef: ArrayLike) -> Float:
        """Legendre coefficients from those of (x - xref)^i (y - yref)^j.

        Parameters
        ----------
        coef : array_like, shape (..., n_terms)
            In the unit of u, v per pixel^(i + j).

        Returns
        -------
        ndarray, same shape
            In the unit of u, v.
        """
        return np.asarray(coef, float) @ self._inverse_monomial_matrix.T
