"""Distortion as a vector field in detector pixels, and the difference of two such fields.

The bands observe the same field of view.  Fields of two bands are compared at the same relative
position on their arrays, with the vectors converted to pixels of the first band.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike

from bayesdist.assess.solution import place_of
from bayesdist.assess.vectors import VectorMap, distortion_vectors
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import PolynomialBasis
from bayesdist.model.grid import grid_pixels
from bayesdist.utils.arrays import Float


@dataclass(frozen=True, eq=False)
class DistortionField:
    """Vectors from detector positions to undistorted positions, zero at the reference pixel."""

    basis: PolynomialBasis
    polynomial: Float  # (2, K), Legendre coefficients of the vectors along x and y, pixels
    to_pixels: Float  # (2, 2), converts offsets in (u, v) of the solution to pixels along x and y

    @classmethod
    def of(cls, basis: PolynomialBasis, polynomial: Float, to_pixels: Float) -> DistortionField:
        """Field from a polynomial (2, K), with its value at the reference pixel subtracted."""
        polynomial = np.array(polynomial, float)
        x, y = basis.reference_pixel
        polynomial[:, 0] -= polynomial @ basis.evaluate([x], [y])[0]
        return cls(basis, polynomial, to_pixels)

    def at_scaled(self, X: ArrayLike, Y: ArrayLike) -> Float:
        """Vectors (2, ...) at scaled coordinates, from -1 to 1 over the array on both axes."""
        X, Y = np.asarray(X, float), np.asarray(Y, float)
        order = self.basis.order
        square = np.zeros((2, order + 1, order + 1))
        square[:, *np.array(self.basis.terms).T] = self.polynomial
        return np.stack(
            [np.asarray(legendre.legval2d(X, Y, coefficients), float) for coefficients in square]
        )

    def minus(self, other: DistortionField, ratio: float = 1.0) -> DistortionField:
        """Difference from another field that covers the same part of the sky.

        `ratio` is the pixel scale of the other array relative to that of this array.  The result is
        in pixels of this array.
        """
        basis = max((self.basis, other.basis), key=lambda b: b.order)
        # terms of lower order come first, and Legendre products depend only on the relative
        # position on the array
        this_polynomial, other_polynomial = (
            np.pad(f.polynomial, ((0, 0), (0, basis.n_terms - f.basis.n_terms)))
            for f in (self, other)
        )
        common_basis = replace(self.basis, order=basis.order)
        return DistortionField(
            common_basis, this_polynomial - ratio * other_polynomial, self.to_pixels
        )

    def vectors(self, grid: tuple[int, int]) -> VectorMap:
        """Vectors in pixels on a grid (nx, ny) from the first to the last pixel."""
        x, y = grid_pixels(self.basis.size, grid)
        du, dv = self.at_scaled(*np.meshgrid(*self.basis.scaled(x, y)))
        return VectorMap(x, y, du, dv, "pix", "no_constant")


def field_of_solution(solution: Solution, *, epoch: float | None = None) -> DistortionField:
    """Distortion of the first chip for the mean of a solution; see `distortion_vectors`.

    `epoch` is in decimal years, and required for a model with time dependence.
    """
    place = place_of(solution.model, epoch=epoch)
    similarity = distortion_vectors(solution, grid=(2, 2), epoch=epoch).similarity
    to_pixels = np.asarray(np.linalg.inv(similarity), float)
    basis = place.basis
    polynomial = to_pixels @ place.polynomial(solution.mean)
    # subtract the detector position: half the size times P_1 along each axis
    polynomial[:, 1:3] -= np.diag(basis.half_size)
    return DistortionField.of(basis, polynomial, to_pixels)
