"""Formal uncertainty over an array, from the number of pairs, their errors and their places alone.

WSDC D-T033, section 6, draws at each place of the array four vectors, to all combinations of
+-sigma_x and +-sigma_y, and prints the largest radius hypot(sigma_x, sigma_y).  What follows here
needs no pairs: sums over them are replaced by integrals over the array, so that the error for each
pair that a published radius implies can be told.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray

from bayesdist.assess.maps import SigmaMap
from bayesdist.errors import DegenerateError, InputError
from bayesdist.model import PolynomialBasis
from bayesdist.model.grid import mesh

__all__ = ["FormalRadii", "corner_weight", "effective_sigma", "formal_radii", "implied_sigma"]

Float = NDArray[np.float64]
OverArray = Callable[[Float, Float], Float]

NODES = 48  # on each axis: integrands are polynomials of twice the order times what is given


@dataclass(frozen=True, eq=False)
class FormalRadii(SigmaMap):
    """Formal standard deviations over an array, in the unit of the errors that were given."""

    def vectors(self, x: float, y: float) -> Float:
        """The four vectors (4, 2) at the grid point nearest to a pixel."""
        at = int(np.argmin(np.abs(self.y - y))), int(np.argmin(np.abs(self.x - x)))
        signs = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
        return signs * np.array([self.sigma_u[at], self.sigma_v[at]])


def formal_radii(
    n_pairs: int,
    sigma: float | tuple[float, float],
    *,
    order: int = 4,
    size: tuple[float, float] = (1016.0, 1016.0),
    grid: tuple[int, int] = (33, 33),
    density: OverArray | None = None,
    weight: OverArray | None = None,
    weight_informs: bool = False,
    correlated: bool = True,
) -> FormalRadii:
    """Formal uncertainty of a polynomial fit, by integrals over the array.

    Parameters
    ----------
    n_pairs : int
    sigma : float or tuple of float
        Error of a pair on each axis.  Of pairs with several errors: `effective_sigma`.
    order : int, optional
        Of the polynomial.
    size : tuple of float, optional
        Columns and rows.
    grid : tuple of int, optional
        Points on x and y, evenly from edge to edge of the array: uncertainty is largest in a
        corner, and grows by 0.6 % over the half pixel to its edge (order 4, 1016 pixels).
    density : callable, optional
        Relative number of pairs by area, of X and Y, which run from -1 to 1 over the array; even
        by default.
    weight : callable, optional
        Extra weight of a pair, likewise; see `corner_weight`.
    weight_informs : bool, optional
        Whether the extra weight is taken for better measurements, as an inverse normal matrix with
        scaled inverse variances has it.  By default it is not: the covariance is the sandwich that
        the true errors make.
    correlated : bool, optional
        False: positions follow from the sigmas of the monomial coefficients alone, as somebody
        would find them from a printed list of coefficients and their errors.

    Returns
    -------
    FormalRadii

    Raises
    ------
    InputError
        For no pairs, errors that are not positive, a density or weight that is negative, and as
        `PolynomialBasis`.
    DegenerateError
        When the pairs lie where they cannot determine the polynomial.
    """
    sigma_u, sigma_v = (sigma, sigma) if np.isscalar(sigma) else sigma  # type: ignore[misc]
    if n_pairs < 1 or not (sigma_u > 0 and sigma_v > 0):
        raise InputError(
            f"{n_pairs} pairs with errors {sigma_u} and {sigma_v} are given",
            do="give one pair or more and positive errors",
        )
    basis = PolynomialBasis(order, size, ((size[0] + 1) / 2, (size[1] + 1) / 2))
    cov = _unit_covariance(basis, density, weight, weight_informs=weight_informs)
    if not correlated:
        _, monomial = basis.to_monomials(np.zeros(basis.n_terms), cov)
        # back by the columns of the inverse map: each coefficient's error moves positions by itself
        back = basis.from_monomials(np.diag(np.sqrt(np.diag(monomial))))
        cov = back.T @ back
    x, y = (np.linspace(0.5, n + 0.5, k) for n, k in zip(size, grid, strict=True))
    phi = basis.evaluate(*mesh(x, y))
    unit = np.sqrt(np.einsum("nk,nk->n", phi @ cov, phi) / n_pairs).reshape(y.size, x.size)
    return FormalRadii(x, y, unit * sigma_u, unit * sigma_v)


def _unit_covariance(
    basis: PolynomialBasis,
    density: OverArray | None,
    weight: OverArray | None,
    *,
    weight_informs: bool,
) -> Float:
    """Covariance of the coefficients of one axis from one pair of error 1, on average."""
    nodes, weights = legendre.leggauss(NODES)
    X, Y = mesh(nodes, nodes)
    share = np.outer(weights, weights).ravel() * _values(density, X, Y, "density")
    share /= share.sum()
    extra = _values(weight, X, Y, "weight")
    phi = basis.evaluate_scaled(X, Y)
    normal = (phi * (share * extra)[:, None]).T @ phi
    # scaled to unit diagonal, so that a small corner of the array counts by its shape alone
    scale = np.sqrt(np.diag(normal))
    if not scale.min() > 0 or np.linalg.cond(normal / np.outer(scale, scale)) > 1e12:
        raise DegenerateError(
            f"the pairs do not determine a polynomial of order {basis.order}",
            where="density",
            do="choose a lower order, or let the pairs cover the array",
        )
    inverse = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    if weight_informs:
        return inverse
    meat = (phi * (share * extra**2)[:, None]).T @ phi
    return inverse @ meat @ inverse


def _values(function: OverArray | None, X: Float, Y: Float, name: str) -> Float:
    if function is None:
        return np.ones_like(X)
    out = np.asarray(function(X, Y), float)
    if not (np.isfinite(out).all() and out.min() >= 0 and out.max() > 0):
        raise InputError(
            "is negative, not finite or zero all over the array",
            where=name,
            do="give a function that is positive where there are pairs",
        )
    return out


def corner_weight(factor: float, *, power: float = 2.0) -> OverArray:
    """Extra weight that grows with the distance from the centre.

    Parameters
    ----------
    factor : float
        In the corners; 1 at the centre.
    power : float, optional
        Of the distance.  The report does not say which.

    Returns
    -------
    callable
        Of X and Y, as `formal_radii` takes it.
    """
    return lambda X, Y: 1.0 + (factor - 1.0) * ((X**2 + Y**2) / 2.0) ** (power / 2.0)


def effective_sigma(sigma: ArrayLike) -> float:
    """The one error that determines a fit as well as several: 1 / sqrt(mean of 1 / sigma^2).

    Parameters
    ----------
    sigma : array_like
        Errors of pairs, which are weighted by their inverse squares.

    Returns
    -------
    float

    Raises
    ------
    InputError
        For errors that are not positive.
    """
    values = np.asarray(sigma, float)
    if values.size == 0 or not values.min() > 0:
        raise InputError("errors must be positive", where="sigma", do="give positive numbers")
    return float(np.mean(values**-2.0) ** -0.5)


def implied_sigma(radius_max: float, n_pairs: int, **options: object) -> float:
    """Error of a pair, equal on both axes, that a largest radius implies.

    Parameters
    ----------
    radius_max : float
        As `FormalRadii.radius_max`.
    n_pairs : int
    **options
        As of `formal_radii`.

    Returns
    -------
    float
        In the unit of the radius.

    Raises
    ------
    InputError, DegenerateError
        As `formal_radii`.
    """
    return radius_max / formal_radii(n_pairs, 1.0, **options).radius_max  # type: ignore[arg-type]
