"""Shift, turn, scale and parity between two maps, by least squares over the area of a chip.

With w = u + i v as Legendre coefficients, mean over the chip,

    w_A = shift + turn w_B + d        (or the conjugate of w_B, where one of them is mirrored)

Products of two polynomials have their means from the coefficients alone, without any grid.
"""

from __future__ import annotations

import numpy as np

from bayesdist.arrays import Complex, Float
from bayesdist.errors import InputError
from bayesdist.model import PolynomialBasis

__all__ = ["as_real", "correlations", "similarity_fields", "turn_between"]


def correlations(
    za: Complex, zb: Complex, basis: PolynomialBasis
) -> tuple[complex, complex, float]:
    """Mean products, about mean positions, of A with B, of A with B mirrored, and of B with itself.

    `za` and `zb` (K,) are coefficients of u + i v.
    """
    weight = basis.mean_squares
    weight[0] = 0.0  # the shift takes the mean
    straight = complex(np.sum(weight * za * zb.conj()))
    flipped = complex(np.sum(weight * za * zb))
    return straight, flipped, float(weight @ np.abs(zb) ** 2)


def turn_between(
    za: Complex, zb: Complex, basis: PolynomialBasis, name: str
) -> tuple[complex, bool]:
    """Scale and rotation that bring B nearest to A, as one complex number; True if mirrored first.

    InputError, with B's `name`, when B maps the chip to one point.
    """
    straight, flipped, norm = correlations(za, zb, basis)
    if norm == 0.0:
        raise InputError("has no linear part", where=name, do="check its coefficients")
    mirrored = bool(abs(flipped) > abs(straight))
    return complex((flipped if mirrored else straight) / norm), mirrored


def as_real(z: Complex) -> Float:
    """Coefficients (2 K,), u before v, of u + i v."""
    return np.concatenate([z.real, z.imag])


def similarity_fields(z: Complex) -> Float:
    """Derivatives (2 K, 4) of positions by shift along u and v, scale and rotation."""
    one = np.zeros_like(z)
    one[0] = 1.0
    offsets = z.copy()
    offsets[0] = 0.0  # about the mean position, so that a rotation is no shift
    return np.stack([as_real(f) for f in (one, 1j * one, offsets, 1j * offsets)], axis=1)
