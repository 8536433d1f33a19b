"""Two-dimensional polynomials as products of Legendre polynomials over the detector.

Monomials of the pixel coordinates are ill-conditioned (condition number 3e16 at order 5), whereas
Legendre products are nearly orthogonal for stars that cover the detector uniformly.  Coefficients
are converted to monomials of pixel offsets, with their covariance, only when files are written.
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
# points that are evaluated together: their 91 terms (order 12) take 24 MB
BLOCK = 32768


@lru_cache
def polynomial_terms(order: int) -> tuple[tuple[int, int], ...]:
    """Powers (i, j) of x and y up to a total order.

    The terms are sorted by total order, then by descending power of x: 1, x, y, x^2, xy, y^2, ...,
    as in Equations 1-2 of Kozhurina-Platais et al. (2015).

    Parameters
    ----------
    order : int
        Total order, 0 or higher.

    Returns
    -------
    tuple of (int, int)
        ``(order + 1) (order + 2) / 2`` pairs.
    """
    return tuple((n - j, j) for n in range(order + 1) for j in range(n + 1))


def n_terms(order: int) -> int:
    """Number of terms of a polynomial of total order `order` in two variables."""
    return (order + 1) * (order + 2) // 2


def polynomial_values(coefficients: Float, x: ArrayLike, y: ArrayLike) -> Float:
    """Evaluate the sum of coefficients[i, j] x^i y^j at points of any shape.

    This is Horner's scheme in place that skips coefficients of zero.  For a triangular coefficient
    matrix and many points, `numpy.polynomial.polynomial.polyval2d` takes eight times as long.
    """
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    out = np.zeros(x.shape)
    for row in coefficients[::-1].tolist():  # lists are faster than arrays for single numbers
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
    """Slices that divide n points into blocks of at most `BLOCK`, to limit memory."""
    for start in range(0, n, BLOCK):
        yield slice(start, min(start + BLOCK, n))


def as_pair(values: Sequence[float]) -> tuple[float, float]:
    """Convert a sequence of two numbers to a tuple of floats."""
    a, b = values
    return float(a), float(b)


def _legendre_derivatives(order: int) -> Float:
    """Square matrix with the Legendre coefficients of P_i' in column i."""
    out = np.zeros((order + 1, order + 1))
    for i in range(1, order + 1):
        out[:i, i] = legendre.legder(np.eye(order + 1)[i, : i + 1])
    return out


def _converted(order: int, convert: Callable[..., Any]) -> Float:
    """Square matrix with the i-th basis function, converted to another basis, in row i."""
    out = np.zeros((order + 1, order + 1))
    for i in range(order + 1):
        out[i, : i + 1] = convert(np.eye(order + 1)[i, : i + 1])
    return out


def _substitute(order: int, scale: float, shift: float) -> Float:
    """Square matrix with the coefficients of z^k in (scale z + shift)^i in row i, column k."""
    out = np.zeros((order + 1, order + 1))
    for i in range(order + 1):
        for k in range(i + 1):
            out[i, k] = comb(i, k) * scale**k * shift ** (i - k)
    return out


def _product_matrix(terms: tuple[tuple[int, int], ...], mx: Float, my: Float) -> Float:
    """Matrix (new, old) that converts 2-D coefficients, from the matrices of the two axes."""
    i, j = np.array(terms).T
    return mx[np.ix_(i, i)].T * my[np.ix_(j, j)].T


@dataclass(frozen=True)
class PolynomialBasis:
    """Products P_i(X) P_j(Y) of Legendre polynomials with i + j <= order over one chip.

    X and Y are detector coordinates scaled to [-1, 1] between the edges of the chip (pixels 0.5 to
    n + 0.5, FITS 1-based).

    Parameters
    ----------
    order : int
        Total order, 1 to 12.
    size : tuple of float
        Numbers of columns and rows of the chip.
    reference_pixel : tuple of float
        Origin (xref, yref) of the monomial form, in FITS 1-based pixels.

    Raises
    ------
    InputError
        If the order is not from 1 to 12 or the size is not positive.

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
        """Degrees (i, j) of the basis functions, in the order of the coefficients."""
        return polynomial_terms(self.order)

    @property
    def n_terms(self) -> int:
        """Number of basis functions, that is, of coefficients per axis."""
        return n_terms(self.order)

    @property
    def mean_squares(self) -> Float:
        """Mean square (n_terms,) of each basis function over the detector."""
        i, j = np.array(self.terms).T
        return 1.0 / ((2 * i + 1) * (2 * j + 1))

    @property
    def half_size(self) -> tuple[float, float]:
        """Half the size of the chip along x and y in pixels, the scale of X and Y."""
        return self.size[0] / 2, self.size[1] / 2

    def scaled(self, x: ArrayLike, y: ArrayLike) -> tuple[Float, Float]:
        """Scale pixel coordinates to [-1, 1].

        Parameters
        ----------
        x, y : array_like
            FITS 1-based pixels.

        Returns
        -------
        X, Y : ndarray
            Scaled coordinates of the same shapes; -1 and 1 are the outer edges of the first and
            last pixel.
        """
        nx, ny = self.size
        return (
            (2.0 * np.asarray(x, float) - (nx + 1.0)) / nx,
            (2.0 * np.asarray(y, float) - (ny + 1.0)) / ny,
        )

    def evaluate(self, x: ArrayLike, y: ArrayLike) -> Float:
        """Values of all basis functions at pixel positions.

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
        """Values of all basis functions at scaled coordinates.

        Parameters
        ----------
        X, Y : array_like, shape (...)
            Coordinates from `scaled`.

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
        """Matrices (n_terms, n_terms) for the derivatives with respect to x and to y.

        Multiplied by the coefficients of a polynomial, they give the coefficients of its derivative
        in the same basis, per pixel.
        """
        derivative_matrix = _legendre_derivatives(self.order)
        i, j = np.array(self.terms).T
        half_x, half_y = self.half_size
        return (
            derivative_matrix[np.ix_(i, i)] * (j[:, None] == j) / half_x,
            derivative_matrix[np.ix_(j, j)] * (i[:, None] == i) / half_y,
        )

    def gradient(self, x: ArrayLike, y: ArrayLike) -> tuple[Float, Float]:
        """Derivatives of all basis functions with respect to the pixel coordinates.

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
        """Matrix (n_terms, n_terms) that converts Legendre to monomial coefficients.

        The monomials are (x - xref)^i (y - yref)^j.
        """
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
        """Convert Legendre coefficients to coefficients of X^i Y^j, as for Horner's scheme.

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
        """Convert Legendre coefficients to coefficients of (x - xref)^i (y - yref)^j.

        Parameters
        ----------
        coef : array_like, shape (..., n_terms)
            Legendre coefficients of one axis, in the unit of u and v.
        cov : array_like, shape (n_terms, n_terms), optional
            Covariance of the Legendre coefficients.

        Returns
        -------
        monomials : ndarray, same shape as `coef`
            In the unit of u and v per pixel^(i + j).
        covariance : ndarray, shape (n_terms, n_terms)
            Covariance of the result; only returned if `cov` is given.
        """
        m = self.monomial_matrix
        out = np.asarray(coef, float) @ m.T
        if cov is None:
            return out
        return out, m @ np.asarray(cov, float) @ m.T

    def from_monomials(self, coef: ArrayLike) -> Float:
        """Convert coefficients of (x - xref)^i (y - yref)^j to Legendre coefficients.

        Parameters
        ----------
        coef : array_like, shape (..., n_terms)
            Monomial coefficients, in the unit of u and v per pixel^(i + j).

        Returns
        -------
        ndarray, same shape
            Legendre coefficients, in the unit of u and v.
        """
        return np.asarray(coef, float) @ self._inverse_monomial_matrix.T
