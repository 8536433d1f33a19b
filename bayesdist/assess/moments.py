"""Second moments of positions from those of polynomial coefficients."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.solution import point_blocks
from bayesdist.model import PolynomialBasis

__all__ = ["position_moments"]

Float = NDArray[np.float64]


def position_moments(
    coefficients: Float, basis: PolynomialBasis, x: Float, y: Float
) -> tuple[Float, Float, Float]:
    """Variances and covariance of (u, v) = sum_k E_k phi_k(x, y) at many points.

    Parameters
    ----------
    coefficients : ndarray, shape (2, K, 2, K)
        Second moments of the coefficients E.
    basis : PolynomialBasis
    x, y : ndarray, shape (N,)
        FITS 1-based pixels.

    Returns
    -------
    uu, vv, uv : ndarray, shape (N,)
    """
    out = np.empty((3, x.size))
    for rows in point_blocks(x.size):
        phi = basis.evaluate(x[rows], y[rows])
        for k, (a, b) in enumerate(((0, 0), (1, 1), (0, 1))):
            out[k, rows] = np.einsum("nk,nk->n", phi @ coefficients[a, :, b, :], phi)
    # rounding may leave a variance of zero slightly below it
    return np.maximum(out[0], 0.0), np.maximum(out[1], 0.0), out[2]
