"""Calibrations in rotated or mirrored pixels.

With pixel offsets w = (u, v) from the reference pixel and an orthogonal matrix M, the new offsets
are w' = M w, and a distortion f = (A, B) becomes

    f'(w') = M f(M^-1 w')

which is linear in the coefficients of both axes together.  At 90, 180 and 270 degrees every
coefficient becomes one other one or its negative: the table of WSDC D-T033 ("WISE IOC Distortion
Calibration"), Appendix A. As there, a frame rotates by +90 degrees when u' = -v and v' = u.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.plane import Plane
from bayesdist.errors import InputError
from bayesdist.model import Chip, DistortionModel

__all__ = ["coefficient_map", "is_exact", "pixel_matrix", "rotated"]

Float = NDArray[np.float64]

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


def rotated(
    calibration: Calibration,
    degrees: float,
    *,
    mirror: bool = False,
    origin: tuple[float, float] = (0.0, 0.0),
) -> Calibration:
    """Calibration in rotated or mirrored pixels, with (u, v) rotated alike.

        (u', v') = origin + M ((u, v) - origin)   at the pixel   w' = M w

    Degrees count from x towards y, and from u towards v, after a mirror of x and u.  The point
    `origin` stays: in pixels of the detector, as WISE has them, its centre.  Every chip is the
    smallest box along the new axes that holds the rotated one, and its first pixel is (1, 1) again:
    at multiples of 90 degrees the rotated image.  InputError for a model with time dependence, or
    an angle that is no finite number.
    """
    solution, model = calibration.solution, calibration.model
    if model.time is not None:
        raise InputError(
            "the solution depends on time",
            where="model.time",
            do="rotate the pixels before the fit, or fit one period",
        )
    M = pixel_matrix(degrees, mirror=mirror)
    new = replace(model, chips=tuple(_turned_chip(chip, M) for chip in model.chips))
    linear = _parameter_map(model, new, M)
    centre = np.asarray(origin, float)
    shift = np.zeros(model.n_params)
    for chip in new.chips:
        for axis in (0, 1):  # P_0 P_0 = 1: the constant is the first coefficient
            first = new.coefficient_slice(chip.number, axis).start
            shift[first] = (centre - M @ centre)[axis]

    def transform(theta: Float) -> Float:
        return np.asarray(theta, float) @ linear.T + shift

    turned = solution.transformed(new, transform, linear)
    return replace(calibration, solution=turned, plane=Plane(), with_plane=None, inverses={})


def _turned_chip(chip: Chip, M: Float) -> Chip:
    """Box along the new axes that holds the rotated chip, its first pixel at (1, 1)."""
    low = 0.5 - np.array(chip.reference_pixel)
    high = low + np.array(chip.size)
    corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])]) @ M.T
    size, reference = np.ptp(corners, axis=0), 0.5 - corners.min(axis=0)
    return replace(
        chip,
        size=(float(size[0]), float(size[1])),
        reference_pixel=(float(reference[0]), float(reference[1])),
    )


def _parameter_map(model: DistortionModel, new: DistortionModel, M: Float) -> Float:
    """Matrix (D, D) from the parameters of one model to those of the other, but for the shift."""
    out = np.zeros((model.n_params, model.n_params))
    exact = is_exact(M)
    for chip in model.chips:
        old_basis, new_basis = model.basis(chip.number), new.basis(chip.number)
        R = coefficient_map(old_basis.terms, M)
        K = old_basis.n_terms
        if not exact:
            to_powers = np.kron(np.eye(2), old_basis.monomial_matrix)
            R = R @ to_powers
            R = np.concatenate(
                [new_basis.from_monomials(half.T).T for half in (R[:K], R[K:])], axis=0
            )
        # Legendre products lie about the middle of the detector and are even or odd as powers are,
        # so that quarter turns act on them as on powers
        columns = [model.coefficient_slice(chip.number, axis) for axis in (0, 1)]
        for i, rows in enumerate(columns):
            for j, cols in enumerate(columns):
                out[rows, cols] = R[i * K : (i + 1) * K, j * K : (j + 1) * K]
    return out
