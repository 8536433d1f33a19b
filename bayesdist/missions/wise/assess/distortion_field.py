"""A distortion as a field of vectors in detector pixels, and how two of them differ.

Fields of two bands are compared at the same place of the sky that both see: at the same part of
their arrays, each band's pixels taken to those of the first.
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
    """Vectors from array positions to undistorted ones, zero at the reference pixel."""

    basis: PolynomialBasis  # over the array
    # (2, K), Legendre coefficients of the vectors along x and y, in pixels of the array
    polynomial: Float
    # (2, 2), takes offsets in the (u, v) of the solution to offsets along x and y in pixels
    to_pixels: Float

    @classmethod
    def of(cls, basis: PolynomialBasis, polynomial: Float, to_pixels: Float) -> DistortionField:
        """The field without its value at the reference pixel.

        `polynomial`: (2, K). `to_pixels`: (2, 2).
        """
        polynomial = np.array(polynomial, float)
        x, y = basis.reference_pixel
        polynomial[:, 0] -= polynomial @ basis.evaluate([x], [y])[0]
        return cls(basis, polynomial, to_pixels)

    def at_scaled(self, X: ArrayLike, Y: ArrayLike) -> Float:
        """Vectors (2, ...) at places of the array, which goes from -1 to 1 on both axes."""
        X, Y = np.asarray(X, float), np.asarray(Y, float)
        order = self.basis.order
        square = np.zeros((2, order + 1, order + 1))
        square[:, *np.array(self.basis.terms).T] = self.polynomial
        return np.stack([np.asarray(legendre.legval2d(X, Y, one), float) for one in square])

    def minus(self, other: DistortionField, ratio: float = 1.0) -> DistortionField:
        """This field less another one that covers the same part of the sky.

        `ratio`: pixels of this array in one of the other: 0.5 where this one's are twice as wide.
        The result is in pixels of this array.
        """
        basis = max((self.basis, other.basis), key=lambda b: b.order)
        # terms of a lower order are the first of a higher one, and Legendre products belong to the
        # whole array, whatever its pixels
        mine, theirs = (
            np.pad(f.polynomial, ((0, 0), (0, basis.n_terms - f.basis.n_terms)))
            for f in (self, other)
        )
        own = replace(self.basis, order=basis.order)
        return DistortionField(own, mine - ratio * theirs, self.to_pixels)

    def vectors(self, grid: tuple[int, int]) -> VectorMap:
        """Vectors on a grid from pixel 1 to the last, both ends.

        `grid`: points on x and y. The result is in pixels.
        """
        x, y = grid_pixels(self.basis.size, grid)
        du, dv = self.at_scaled(*np.meshgrid(*self.basis.scaled(x, y)))
        return VectorMap(x, y, du, dv, "pix", "no_constant")


def field_of_solution(solution: Solution, *, epoch: float | None = None) -> DistortionField:
    """The distortion of a solution's mean on its first chip, as `distortion_vectors` defines it.

    `epoch`: decimal years; needed by a model with time dependence. InputError as
    `distortion_vectors`.
    """
    place = place_of(solution.model, epoch=epoch)
    similarity = distortion_vectors(solution, grid=(2, 2), epoch=epoch).similarity
    to_pixels = np.asarray(np.linalg.inv(similarity), float)
    basis = place.basis
    polynomial = to_pixels @ place.polynomial(solution.mean)
    # the array position itself: P_1 along each axis, half the size times it
    polynomial[:, 1:3] -= np.diag(basis.half_size)
    return DistortionField.of(basis, polynomial, to_pixels)
