"""The inverse polynomials AP and BP: their fit, and how well they undo A and B."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import InputError
from bayesdist.model import PolynomialBasis
from bayesdist.products.sip import SipHeader

__all__ = ["detector_grid", "fit_inverse", "worst_closure"]

Float = NDArray[np.float64]
Terms = dict[tuple[int, int], float]
Forward = Callable[[Float, Float], tuple[Float, Float]]

_FIT_NODES, _CHECK_NODES = 65, 257


def detector_grid(
    size: tuple[float, float], nodes: int = _CHECK_NODES, *, chebyshev: bool = False
) -> tuple[Float, Float]:
    """Grid over the pixel centres from corner to corner, flattened.

    Parameters
    ----------
    size : tuple of float
        Columns and rows.
    nodes : int
        Points of each axis.
    chebyshev : bool
        Crowd the points towards the edges as Chebyshev's extrema are.

    Returns
    -------
    x, y : ndarray, shape (nodes^2,)
    """
    t = np.linspace(-1.0, 1.0, nodes)
    if chebyshev:
        t = np.sin(t * np.pi / 2)
    axes = [(n + 1) / 2 + (n - 1) / 2 * t for n in size]
    x, y = np.meshgrid(*axes)
    return x.ravel(), y.ravel()


def fit_inverse(
    forward: Forward, crpix: tuple[float, float], size: tuple[float, float], order: int
) -> tuple[Terms, Terms]:
    """Least-squares fit of u - U and v - V as polynomials of (U, V).

    Orthogonal polynomials over the bounding box of the detector's image carry the fit.  Its points
    are denser at the detector's edges (Chebyshev's extrema): that halves the worst error, which a
    uniform grid leaves in the corners.

    Parameters
    ----------
    forward : callable
        Pixels (x, y) to corrected offsets (U, V).
    crpix : tuple of float
    size : tuple of float
        Columns and rows.
    order : int
        Total order of the inverse.

    Returns
    -------
    ap, bp : dict
        From powers (p, q) of U, V to the coefficient.

    Raises
    ------
    InputError
        When the forward map folds the detector onto itself, so that there is no inverse.
    """
    x, y = detector_grid(size, _FIT_NODES, chebyshev=True)
    U, V = forward(x, y)
    _check_one_to_one(U, V)
    extent = np.ptp(U), np.ptp(V)
    # a basis is made for pixels 0.5 .. n + 0.5: move the box there, and its zero point with it
    zero = [(n + 1) / 2 - (w.max() + w.min()) / 2 for n, w in zip(extent, (U, V), strict=True)]
    basis = PolynomialBasis(order, extent, (zero[0], zero[1]))
    design = basis.evaluate(U + zero[0], V + zero[1])
    wanted = np.stack([x - crpix[0] - U, y - crpix[1] - V], axis=1)
    fitted = np.linalg.lstsq(design, wanted, rcond=None)[0]
    ap, bp = basis.to_monomials(fitted.T)
    return (
        dict(zip(basis.terms, ap.tolist(), strict=True)),
        dict(zip(basis.terms, bp.tolist(), strict=True)),
    )


def _check_one_to_one(U: Float, V: Float) -> None:
    """The cells of the grid must all keep their sense of rotation."""
    u, v = U.reshape(_FIT_NODES, _FIT_NODES), V.reshape(_FIT_NODES, _FIT_NODES)
    du_x, dv_x = u[:-1, 1:] - u[:-1, :-1], v[:-1, 1:] - v[:-1, :-1]
    du_y, dv_y = u[1:, :-1] - u[:-1, :-1], v[1:, :-1] - v[:-1, :-1]
    area = du_x * dv_y - du_y * dv_x
    if area.min() <= 0:
        raise InputError(
            "the distortion maps several pixels to one position, so it has no inverse",
            do="lower the order or fit stars over the whole detector",
        )


def worst_closure(sip: SipHeader, size: tuple[float, float]) -> float:
    """Largest distance between a pixel and the inverse of its forward position.

    Parameters
    ----------
    sip : SipHeader
        With an inverse.
    size : tuple of float
        Columns and rows.

    Returns
    -------
    float
        Pixels, over a grid of 257 x 257 pixels from corner to corner.

    Raises
    ------
    InputError
        When the header has no inverse.
    """
    x, y = detector_grid(size)
    back_x, back_y = sip.inverse(*sip.forward(x, y))
    return float(np.hypot(back_x - x, back_y - y).max())
