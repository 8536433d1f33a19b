"""Coefficients of a distortion in rotated or mirrored pixels.

With pixel offsets w = (u, v) from the reference pixel and an orthogonal matrix M, the new offsets
are w' = M w, and a distortion f = (A, B) becomes

    f'(w') = M f(M^-1 w')

which is linear in the coefficients of both axes together.  At 90, 180 and 270 degrees every
coefficient becomes one other one or its negative: the table of WSDC D-T033 ("WISE IOC Distortion
Calibration"), Appendix A. As there, a frame rotates by +90 degrees when u' = -v and v' = u.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import comb

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.arrays import Float
from bayesdist.errors import InputError

__all__ = ["coefficient_map", "is_exact", "pixel_matrix"]

# Exact, as cosines and sines are not.
_QUARTERS = {0.0: (1.0, 0.0), 90.0: (0.0, 1.0), 180.0: (-1.0, 0.0), 270.0: (0.0, -1.0)}


def pixel_matrix(degrees: float, *, mirror: bool = False) -> Float:
    """Matrix M (2, 2) of pixel offsets, w' = M w: a rotation from u towards v, after a mirror of u.

    Whole numbers at multiples of 90 degrees; InputError when the angle is no finite number.
    """
    if not np.isfinite(degrees):
        raise InputError(f"the angle is {degrees}", where="degrees", do="give a finite number")
    turn = float(degrees) % 360.0
    angle = np.deg2rad(turn)
    c, s = _QUARTERS.get(turn, (np.cos(angle), np.sin(angle)))
    matrix = np.array([[c, -s], [s, c]])
    if mirror:
        matrix[:, 0] *= -1
    return matrix + 0.0  # no negative zeros


def coefficient_map(terms: Sequence[tuple[int, int]], matrix: ArrayLike) -> Float:
    """Matrix R (2 K, 2 K) from the coefficients of (A, B) to those in a changed pixel frame.

    New coefficients are R c, with c those of A followed by those of B, each in the order of `terms`
    (powers of u and v, complete in each total order); their covariance is R cov R^T. A signed
    permutation at multiples of 90 degrees.  InputError when the terms of one total order are not
    all there, or the matrix is not orthogonal.
    """
    M = np.asarray(matrix, float)
    if M.shape != (2, 2) or not np.allclose(M @ M.T, np.eye(2), atol=1e-12, rtol=0):
        raise InputError("is not orthogonal", where="matrix", do="take it from pixel_matrix")
    place = {term: k for k, term in enumerate(terms)}
    # old offsets from new ones: u = back[0] . w',  v = back[1] . w'
    back = M.T
    powers = np.zeros((len(terms), len(terms)))
    for (p, q), old in place.items():
        for k in range(p + 1):
            for m in range(q + 1):
                weight = comb(p, k) * comb(q, m) * back[0, 0] ** k * back[0, 1] ** (p - k)
                weight *= back[1, 0] ** m * back[1, 1] ** (q - m)
                if weight == 0.0:
                    continue
                new = place.get((k + m, p + q - k - m))
                if new is None:
                    raise InputError(
                        f"of total order {p + q} some are missing, which rotation mixes",
                        where="terms",
                        do="give all terms of the order, those that are zero as well",
                    )
                powers[new, old] += weight
    return np.kron(M, powers)


def is_exact(M: Float) -> bool:
    """True where the rotated axes lie along axes again."""
    return bool(np.all(np.round(M) == M))
