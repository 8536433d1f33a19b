"""INVERSE rows of an IDCTAB: from (Xc, Yc) back to pixels, as polynomials of the forward's order.

    x - XREF = sum CXnj Xc^j Yc^(n-j),   y - YREF = sum CYnj Xc^j Yc^(n-j)

pixels from arcseconds (ACS handbook 4.1.5).  stwcs has no use for them; other programs start their
iterations there, so that the closure matters and is stated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from bayesdist.calibration.inverse import detector_grid
from bayesdist.errors import InputError
from bayesdist.products.formats.common.coefficients import idctab_powers
from bayesdist.products.formats.idctab.numbers import ChipNumbers

__all__ = ["ChipInverse", "inverse_of"]

Float = NDArray[np.float64]

_FIT_NODES = 33


@dataclass(frozen=True, eq=False)
class ChipInverse:
    """The inverse polynomials of one chip, at the reference date of its drift.

    Parameters
    ----------
    names : tuple of str
        CX10, CX11, ..., CY10, ..., as in the forward row.
    values : ndarray, shape (P,)
        Pixels per arcsec^n.
    jacobian : ndarray, shape (P, P)
        Derivatives by the forward coefficients of the same names.
    closure : float
        Largest distance between a pixel and the inverse of its forward position, pixels.
    """

    names: tuple[str, ...]
    values: Float
    jacobian: Float
    closure: float


def inverse_of(numbers: ChipNumbers) -> ChipInverse:
    """Least-squares inverse of a chip's forward polynomials, over the whole chip.

    Parameters
    ----------
    numbers : ChipNumbers

    Returns
    -------
    ChipInverse

    Raises
    ------
    InputError
        When the map folds the chip onto itself.

    Notes
    -----
    There is no constant term: (0, 0) is XREF, YREF in both directions.
    """
    names = tuple(name for name in numbers.names if name.startswith("C"))
    n = len(names) // 2
    powers = [(p[1], p[2]) for p in map(idctab_powers, names[:n]) if p is not None]
    forward = np.array([numbers.column(name) for name in names]).reshape(2, n)

    x, y = _offsets(numbers, detector_grid(numbers.chip.size, _FIT_NODES, chebyshev=True))
    phi = _monomials(powers, x, y)
    X, Y = forward @ phi.T
    scale = float(max(np.abs(X).max(), np.abs(Y).max()))  # keeps the design well conditioned
    order = np.array([i + j for i, j in powers])
    q, r = np.linalg.qr(_monomials(powers, X / scale, Y / scale))
    projection = solve_triangular(r, q.T) / (scale**order)[:, None]
    values = (projection @ np.stack([x, y], axis=1)).T

    # at a fixed position a change dX of the forward map moves the pixel by -(dX/dx)^-1 dX
    slope = np.stack([forward @ _monomials(powers, x, y, by=axis).T for axis in (0, 1)], axis=1)
    a, b, c, d = slope[0, 0], slope[0, 1], slope[1, 0], slope[1, 1]
    determinant = a * d - b * c
    if determinant.min() <= 0 < determinant.max():
        raise InputError(
            f"the distortion of chip {numbers.chip.number} maps several pixels to one position",
            where="INVERSE rows",
            do="lower the order, fit stars over the whole chip, or leave the inverse out",
        )
    back = -np.array([[d, -b], [-c, a]]) / determinant
    jacobian = np.einsum("kn,abn,nl->akbl", projection, back, phi, optimize=True)
    jacobian = jacobian.reshape(2 * n, 2 * n)

    x, y = _offsets(numbers, detector_grid(numbers.chip.size))
    X, Y = forward @ _monomials(powers, x, y).T
    left = values @ _monomials(powers, X, Y).T - np.stack([x, y])
    return ChipInverse(names, values.ravel(), jacobian, float(np.hypot(*left).max()))


def _offsets(numbers: ChipNumbers, pixels: tuple[Float, Float]) -> tuple[Float, Float]:
    x, y = pixels
    return x - numbers.chip.reference_pixel[0], y - numbers.chip.reference_pixel[1]


def _monomials(powers: list[tuple[int, int]], x: Float, y: Float, by: int | None = None) -> Float:
    """Columns x^i y^j, or their derivatives by x (0) or y (1)."""
    i, j = np.array(powers).T
    px, py = (polynomial.polyvander(w, int(max(i.max(), j.max()))) for w in (x, y))
    if by == 0:
        return i * px[:, np.maximum(i - 1, 0)] * py[:, j]
    if by == 1:
        return j * px[:, i] * py[:, np.maximum(j - 1, 0)]
    return px[:, i] * py[:, j]
