"""Explicit inverses: polynomials from positions to pixels, and their closure errors.

    (U, V) = L^-1 (position - zero),    x = x0 + U + P(U, V),    y = y0 + V + Q(U, V)

This package inverts the forward polynomials by Newton's method instead.  Explicit inverses are
needed for programs that cannot iterate or that use them as a starting point.  AP and BP of SIP have
this form, with the CD matrix as L, and so have inverse rows of tables of coefficients, with L = 1
and P(0, 0) = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.calibration.chip_map import ChipMap
from bayesdist.errors import InputError
from bayesdist.model import PolynomialBasis
from bayesdist.model.basis import MAX_ORDER, polynomial_values
from bayesdist.utils.arrays import Float

Terms = Mapping[tuple[int, int], float]
Forward = Callable[[Float, Float], tuple[Float, Float]]

# points per axis of the grids for the fits and for the closure errors
FIT_NODES, CHECK_NODES = 65, 257


@dataclass(frozen=True, eq=False)
class ExplicitInverse:
    """Inverse map of one chip: pixels as polynomials of positions."""

    reference_pixel: tuple[float, float]  # (x0, y0), FITS 1-based
    x_terms: Terms  # coefficients of P by powers (p, q) of (U, V), pixels
    y_terms: Terms  # coefficients of Q
    zero: tuple[float, float] = (0.0, 0.0)  # position (u, v) of the reference pixel
    linear: Float | None = None  # L (2, 2); the identity if None
    # (2 n, 2 K), derivatives of the n terms, x first, with respect to the map's coefficients
    jacobian: Float | None = None

    @property
    def order(self) -> int:
        """Total order of the polynomials."""
        return max(i + j for i, j in self.x_terms)

    def pixels(self, u: ArrayLike, v: ArrayLike) -> tuple[Float, Float]:
        """FITS 1-based pixels x and y of positions (N,)."""
        at = np.stack([np.asarray(u, float) - self.zero[0], np.asarray(v, float) - self.zero[1]])
        U, V = at if self.linear is None else np.linalg.solve(self.linear, at)
        x, y = (_value(terms, U, V) for terms in (self.x_terms, self.y_terms))
        return self.reference_pixel[0] + U + x, self.reference_pixel[1] + V + y

    def misses(self, chip: ChipMap) -> tuple[float, float]:
        """Closure error: largest and rms distance, in pixels, after the map and this inverse."""
        x, y = detector_grid(chip.basis.size)
        back = self.pixels(*chip.at(x, y))
        far = np.hypot(back[0] - x, back[1] - y)
        return float(far.max()), float(np.sqrt(np.mean(far**2)))


def fitted_inverse(
    chip: ChipMap,
    order: int | None = None,
    *,
    nodes: int = FIT_NODES,
    constant: bool = True,
    linear: Float | None = None,
) -> ExplicitInverse:
    """Fit an explicit inverse to a map over the whole chip.

    Parameters
    ----------
    chip : ChipMap
    order : int, optional
        Order of the inverse, 1 to 12; by default one above that of the map.
    nodes : int
        Points per axis of the grid for the fit.
    constant : bool
        True if P and Q have constant terms.
    linear : ndarray, shape (2, 2), optional
        Matrix L; by default the derivatives at the reference pixel.

    Returns
    -------
    ExplicitInverse
        Inverse with the derivatives of its terms.

    Raises
    ------
    InputError
        If the order is not from 1 to 12, or the map is not one-to-one.
    """
    basis = chip.basis
    if order is None:
        order = min(basis.order + 1, MAX_ORDER)
    if isinstance(order, bool) or order not in range(1, MAX_ORDER + 1):
        raise InputError(
            f"the order of the inverse is {order!r}",
            where="order",
            do=f"choose one from 1 to {MAX_ORDER}",
        )
    x0, y0 = basis.reference_pixel
    L = chip.linear if linear is None else linear
    zero = chip.at([x0], [y0])[:, 0]
    x, y = detector_grid(basis.size, nodes, chebyshev=True)
    U, V = np.linalg.solve(L, chip.at(x, y) - zero[:, None])
    slope = chip.slope(x, y)
    check_one_to_one(U, V, nodes, np.linalg.det(slope) / np.linalg.det(L))
    fit = _InverseFit.of(U, V, order, constant=constant)
    offsets = np.stack([x - x0 - U, y - y0 - V], axis=1)
    terms = fit.terms(offsets)
    # at a fixed position a change dX of the forward map shifts the pixel by -(dX/dx)^-1 dX
    phi = basis.evaluate(x, y)
    if not constant:
        phi = phi - basis.evaluate([x0], [y0])  # the reference pixel is not shifted
    back = -np.linalg.inv(slope)
    jacobian = np.einsum("kn,nab,nl->akbl", fit.projection, back, phi, optimize=True)
    return ExplicitInverse(
        (x0, y0),
        *terms,
        zero=(float(zero[0]), float(zero[1])),
        linear=L,
        jacobian=jacobian.reshape(2 * fit.projection.shape[0], -1),
    )


def fit_inverse(
    forward: Forward, reference_pixel: tuple[float, float], size: tuple[float, float], order: int
) -> tuple[Terms, Terms]:
    """Fit the inverse polynomials P and Q of a map from pixels (x, y) to (U, V).

    `forward` maps FITS 1-based pixels x, y (N,) to U, V (N,) in pixels.  `size` has the columns and
    rows of the chip, and `order` is the total order of P and Q.  The pixel minus `reference_pixel`
    (FITS 1-based) is U + P(U, V) and V + Q(U, V).

    The fit uses orthogonal polynomials over the bounding box of the mapped detector.  The grid
    consists of Chebyshev extrema, which are denser near the edges of the detector; this halves the
    largest error, which occurs in the corners for a uniform grid.

    Returns
    -------
    x_terms, y_terms : dict
        Coefficients of P and Q by powers of (U, V).

    Raises
    ------
    InputError
        If the map is not one-to-one over the detector.
    """
    x, y = detector_grid(size, FIT_NODES, chebyshev=True)
    U, V = forward(x, y)
    check_one_to_one(U, V, FIT_NODES)
    offsets = np.stack([x - reference_pixel[0] - U, y - reference_pixel[1] - V], axis=1)
    return _InverseFit.of(U, V, order, constant=True).terms(offsets)


def detector_grid(
    size: tuple[float, float], nodes: int = CHECK_NODES, *, chebyshev: bool = False
) -> tuple[Float, Float]:
    """Grid x, y (nodes^2,) between the centres of the corner pixels, FITS 1-based.

    `size` has columns and rows.  The grid is uniform, or denser near the edges if `chebyshev`.
    """
    t = np.linspace(-1.0, 1.0, nodes)
    if chebyshev:
        t = np.sin(t * np.pi / 2)
    axes = [(n + 1) / 2 + (n - 1) / 2 * t for n in size]
    x, y = np.meshgrid(*axes)
    return x.ravel(), y.ravel()


def check_one_to_one(U: Float, V: Float, nodes: int, areas: Float | None = None) -> None:
    """Raise InputError if a map is folded, that is, if a cell of the grid changes its parity.

    U and V (nodes^2,) are positions on a regular grid; `areas` are the signed areas of its cells
    (default: computed from U and V).
    """
    if areas is None:
        u, v = U.reshape(nodes, nodes), V.reshape(nodes, nodes)
        du_x, dv_x = u[:-1, 1:] - u[:-1, :-1], v[:-1, 1:] - v[:-1, :-1]
        du_y, dv_y = u[1:, :-1] - u[:-1, :-1], v[1:, :-1] - v[:-1, :-1]
        areas = du_x * dv_y - du_y * dv_x
    if areas.min() <= 0:
        raise InputError(
            "the distortion maps several pixels to one position, so it has no inverse",
            do="lower the order, or fit stars that cover the whole detector",
        )


@dataclass(frozen=True, eq=False)
class _InverseFit:
    """Least-squares fit of orthogonal polynomials over the bounding box of N points."""

    basis: PolynomialBasis
    design: Float  # (N, K); (N, K - 1) if the functions vanish at (0, 0)
    at_zero: Float | None  # (K - 1,), values at (0, 0) that were subtracted so that they vanish

    @classmethod
    def of(cls, U: Float, V: Float, order: int, *, constant: bool) -> _InverseFit:
        extent = np.ptp(U), np.ptp(V)
        # a basis covers pixels 0.5 to n + 0.5, so the box and its zero point are shifted there
        zero = [(n + 1) / 2 - (w.max() + w.min()) / 2 for n, w in zip(extent, (U, V), strict=True)]
        basis = PolynomialBasis(order, extent, (zero[0], zero[1]))
        design = basis.evaluate(U + zero[0], V + zero[1])
        if constant:
            return cls(basis, design, None)
        at_zero = basis.evaluate([zero[0]], [zero[1]])[0, 1:]
        return cls(basis, design[:, 1:] - at_zero, at_zero)

    def _monomials(self, fitted: Float) -> Float:
        """Convert coefficients of the design's functions to those (K, M) of powers of U and V."""
        if self.at_zero is None:
            return self.basis.monomial_matrix @ fitted
        with_constant = np.concatenate([-(self.at_zero @ fitted)[None], fitted])
        out = self.basis.monomial_matrix @ with_constant
        out[0] = 0.0
        return out

    def terms(self, wanted: Float) -> tuple[Terms, Terms]:
        """Fit polynomials to values (N, 2); coefficients by power for both columns."""
        fitted = np.asarray(np.linalg.lstsq(self.design, wanted, rcond=None)[0], float)
        powers = self.basis.terms
        x, y = (
            self.basis.to_monomials(fitted.T) if self.at_zero is None else self._monomials(fitted).T
        )
        keep = slice(None) if self.at_zero is None else slice(1, None)
        return (
            dict(zip(powers[keep], x[keep].tolist(), strict=True)),
            dict(zip(powers[keep], y[keep].tolist(), strict=True)),
        )

    @property
    def projection(self) -> Float:
        """Matrix (n, N) that converts values at the points to coefficients of powers."""
        out = self._monomials(np.asarray(np.linalg.pinv(self.design), float))
        return out if self.at_zero is None else out[1:]


def _value(terms: Terms, U: Float, V: Float) -> Float:
    n = max(max(powers) for powers in terms) if terms else 0
    matrix = np.zeros((n + 1, n + 1))
    for (i, j), value in terms.items():
        matrix[i, j] = value
    return polynomial_values(matrix, U, V)
