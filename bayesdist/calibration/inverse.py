"""Explicit inverses: polynomials from positions back to pixels, and their closure errors.

    (U, V) = L^-1 (position - zero),    x = x0 + U + P(U, V),    y = y0 + V + Q(U, V)

Newton's method on the forward polynomials does not need them; programs that cannot iterate, or
start their iterations there, do.  AP and BP of SIP are of this form, with L the CD matrix; so are
INVERSE rows of an IDCTAB, with L = 1 and P(0, 0) = 0.
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

# Points of each axis: of the fits, and of the check of their closure.
FIT_NODES, CHECK_NODES = 65, 257


@dataclass(frozen=True, eq=False)
class ExplicitInverse:
    """Pixels of one chip as polynomials of positions."""

    reference_pixel: tuple[float, float]  # (x0, y0), FITS 1-based
    x_terms: Terms  # P by powers (p, q) of (U, V), pixels
    y_terms: Terms  # Q
    zero: tuple[float, float] = (0.0, 0.0)  # position of the reference pixel
    linear: Float | None = None  # L (2, 2); 1 if None
    jacobian: Float | None = None  # (2 n, 2 K), of the terms (x first) by the map's coefficients

    @property
    def order(self) -> int:
        """Largest total power."""
        return max(i + j for i, j in self.x_terms)

    def pixels(self, u: ArrayLike, v: ArrayLike) -> tuple[Float, Float]:
        """Pixels, FITS 1-based, of positions (N,)."""
        at = np.stack([np.asarray(u, float) - self.zero[0], np.asarray(v, float) - self.zero[1]])
        U, V = at if self.linear is None else np.linalg.solve(self.linear, at)
        x, y = (_value(terms, U, V) for terms in (self.x_terms, self.y_terms))
        return self.reference_pixel[0] + U + x, self.reference_pixel[1] + V + y

    def misses(self, chip: ChipMap) -> tuple[float, float]:
        """Largest and rms distance over a chip of pixels from their images there and back."""
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
    """Inverse of a map, fitted over the whole chip, with its derivatives.

    The order is by default one above that of the map, and at most 12; `nodes` are the points of
    each axis; P and Q have constant terms with `constant`; L is by default the derivatives at the
    reference pixel.  InputError for an order outside 1 to 12, or a chip that is folded onto itself.
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
    fit = _Fit.of(U, V, order, constant=constant)
    offsets = np.stack([x - x0 - U, y - y0 - V], axis=1)
    terms = fit.terms(offsets)
    # at a fixed position a change dX of the forward map moves the pixel by -(dX/dx)^-1 dX
    phi = basis.evaluate(x, y)
    if not constant:
        phi = phi - basis.evaluate([x0], [y0])  # the reference pixel stays where it is
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
) -> tuple[dict[tuple[int, int], float], dict[tuple[int, int], float]]:
    """Terms P and Q, by powers of (U, V), of the inverse of a map from pixels (x, y) to (U, V).

    Orthogonal polynomials over the bounding box of the detector's image carry the fit.  Its points
    are denser at the detector's edges (Chebyshev's extrema): that halves the worst error, which a
    uniform grid leaves in the corners.  InputError when the map folds the detector onto itself, so
    that there is no inverse.
    """
    x, y = detector_grid(size, FIT_NODES, chebyshev=True)
    U, V = forward(x, y)
    check_one_to_one(U, V, FIT_NODES)
    offsets = np.stack([x - reference_pixel[0] - U, y - reference_pixel[1] - V], axis=1)
    return _Fit.of(U, V, order, constant=True).terms(offsets)


def detector_grid(
    size: tuple[float, float], nodes: int = CHECK_NODES, *, chebyshev: bool = False
) -> tuple[Float, Float]:
    """Grid x, y (nodes^2,) over the pixel centres from corner to corner, even or Chebyshev's."""
    t = np.linspace(-1.0, 1.0, nodes)
    if chebyshev:
        t = np.sin(t * np.pi / 2)
    axes = [(n + 1) / 2 + (n - 1) / 2 * t for n in size]
    x, y = np.meshgrid(*axes)
    return x.ravel(), y.ravel()


def check_one_to_one(U: Float, V: Float, nodes: int, areas: Float | None = None) -> None:
    """Refuse a map that folds the detector: cells of a grid of it must keep their sense."""
    if areas is None:
        u, v = U.reshape(nodes, nodes), V.reshape(nodes, nodes)
        du_x, dv_x = u[:-1, 1:] - u[:-1, :-1], v[:-1, 1:] - v[:-1, :-1]
        du_y, dv_y = u[1:, :-1] - u[:-1, :-1], v[1:, :-1] - v[:-1, :-1]
        areas = du_x * dv_y - du_y * dv_x
    if areas.min() <= 0:
        raise InputError(
            "the distortion maps several pixels to one position, so it has no inverse",
            do="lower the order or fit stars over the whole detector",
        )


@dataclass(frozen=True, eq=False)
class _Fit:
    """Least squares by orthogonal polynomials over the bounding box of some points."""

    basis: PolynomialBasis
    design: Float  # (N, K), or (N, K - 1) of functions that vanish at (0, 0)
    at_zero: Float | None  # (K - 1,): constants that make them vanish

    @classmethod
    def of(cls, U: Float, V: Float, order: int, *, constant: bool) -> _Fit:
        extent = np.ptp(U), np.ptp(V)
        # a basis is made for pixels 0.5 .. n + 0.5: move the box there, its zero point with it
        zero = [(n + 1) / 2 - (w.max() + w.min()) / 2 for n, w in zip(extent, (U, V), strict=True)]
        basis = PolynomialBasis(order, extent, (zero[0], zero[1]))
        design = basis.evaluate(U + zero[0], V + zero[1])
        if constant:
            return cls(basis, design, None)
        at_zero = basis.evaluate([zero[0]], [zero[1]])[0, 1:]
        return cls(basis, design[:, 1:] - at_zero, at_zero)

    def _monomials(self, fitted: Float) -> Float:
        """Coefficients (K, M) of powers of U, V, from those of the functions of the design."""
        if self.at_zero is None:
            return self.basis.monomial_matrix @ fitted
        whole = np.concatenate([-(self.at_zero @ fitted)[None], fitted])
        out = self.basis.monomial_matrix @ whole
        out[0] = 0.0
        return out

    def terms(self, wanted: Float) -> tuple[dict, dict]:
        """Polynomials through values (N, 2), as powers and their coefficients."""
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
        """Matrix (n, N) from values at the points to the coefficients of powers."""
        out = self._monomials(np.asarray(np.linalg.pinv(self.design), float))
        return out if self.at_zero is None else out[1:]


def _value(terms: Terms, U: Float, V: Float) -> Float:
    n = max(max(powers) for powers in terms) if terms else 0
    matrix = np.zeros((n + 1, n + 1))
    for (i, j), value in terms.items():
        matrix[i, j] = value
    return polynomial_values(matrix, U, V)
