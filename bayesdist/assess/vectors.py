"""Distortion vectors over the detector."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bayesdist.assess.comparison.frame import turn_matrix
from bayesdist.assess.solution import Place, place_of
from bayesdist.errors import InputError, require_known
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import Chip
from bayesdist.model.basis import point_blocks
from bayesdist.model.grid import DEFAULT_GRID, grid_pixels, mesh, position_of_largest
from bayesdist.utils.arrays import Float

PARTS = ("no_constant", "non_linear")
VECTORS_ALONG = 17  # number of vectors along the longer side of a chip; more would overlap

# u, v in pixels are compared with the pixel position itself if the best-fitting similarity is
# as close to the identity as this (scale from 0.9 to 1.1, rotation below 6 degrees).
NEAR_IDENTITY = 0.1


@dataclass(frozen=True, eq=False)
class VectorMap:
    """Displacement vectors over the detector.

    Parameters
    ----------
    x : ndarray, shape (nx,)
        FITS 1-based columns.
    y : ndarray, shape (ny,)
        FITS 1-based rows.
    du, dv : ndarray, shape (ny, nx)
        Displacement along u and v, in `unit`.
    unit : str
        Unit of u and v.
    part : str
        One of `PARTS`.
    part_note : str
        Text that tells readers what the displacement is relative to.
    similarity : ndarray, shape (2, 2)
        Linear map from pixel offsets to offsets in (u, v): the identity if u, v are along the pixel
        axes, otherwise the best-fitting scale, rotation and parity.
    """

    x: Float
    y: Float
    du: Float
    dv: Float
    unit: str
    part: str
    part_note: str = ""
    similarity: Float = field(default_factory=lambda: np.eye(2))

    @property
    def length(self) -> Float:
        """Length of the vectors, (ny, nx), in `unit`."""
        return np.hypot(self.du, self.dv)

    @property
    def length_max(self) -> float:
        """Largest length, in `unit`."""
        return float(self.length.max())

    @property
    def position_of_max(self) -> tuple[float, float]:
        """Pixel (x, y) of the largest length."""
        return position_of_largest(self.length, self.x, self.y)

    @property
    def on_detector(self) -> tuple[Float, Float]:
        """Vectors along the detector's x and y, in pixels, each of shape (ny, nx).

        Diagrams over the detector show these. They equal (du, dv) if `similarity` is the identity.
        """
        d = np.linalg.solve(self.similarity, np.stack([self.du.ravel(), self.dv.ravel()]))
        return d[0].reshape(self.du.shape), d[1].reshape(self.dv.shape)


def distortion_vectors(
    solution: Solution,
    *,
    grid: tuple[int, int] = DEFAULT_GRID,
    part: str = "no_constant",
    epoch: float | None = None,
    chip: int | None = None,
) -> VectorMap:
    """Distortion of a solution's mean as vectors, without its constant or its linear part.

    Parameters
    ----------
    solution : LinearFit or Posterior
    grid : tuple of int
        Number of points along x and y.
    part : str
        'no_constant': displacement from the pixel position to the corrected position, relative to
        that of the reference pixel, as in the diagrams of section 4 of WSDC D-T033. If u, v are
        angles, or pixels along rotated or mirrored axes, the pixel position is first transformed by
        the similarity (scale, rotation, parity) that fits best over the detector.
        'non_linear': only terms of order 2 and higher about the reference pixel, as in Figure 4.1
        of section 4.1 of the camera's handbook.
    epoch : float, optional
        Decimal years; required if the model depends on time.
    chip : int, optional
        Chip number; the first chip by default.

    Returns
    -------
    VectorMap

    Raises
    ------
    InputError
        If the part or chip is unknown, the epoch is missing, the grid is invalid, or the solution
        has no linear part.
    """
    require_known(part, PARTS, "part of the distortion", where="part")
    place = place_of(solution.model, epoch=epoch, chip=chip)
    basis, reference = place.basis, np.array(place.chip.reference_pixel)
    # Legendre coefficients (2, K) of positions and of pixels, relative to the reference pixel
    polynomial = place.polynomial(solution.mean).copy()
    polynomial[:, 0] -= polynomial @ basis.evaluate(*reference[:, None])[0]
    pixels = basis.from_monomials(np.eye(basis.n_terms)[1:3])
    similarity, note = _similarity(place, polynomial, pixels)
    linear = similarity
    if part == "non_linear":
        linear = basis.to_monomials(polynomial)[:, 1:3]
        note = "the terms of order 2 and more about the reference pixel"
    x, y = grid_pixels(place.chip.size, grid)
    X, Y = mesh(x, y)
    displacement = polynomial - linear @ pixels
    d = [displacement @ basis.evaluate(X[rows], Y[rows]).T for rows in point_blocks(X.size)]
    du, dv = np.concatenate(d, axis=1).reshape(2, y.size, x.size)
    return VectorMap(x, y, du, dv, solution.model.unit, part, note, similarity)


def diagram_vectors(
    solution: Solution, chip: Chip, *, part: str = "no_constant", epoch: float | None = None
) -> VectorMap:
    """Distortion of a chip on a grid for a diagram, with the same spacing along both axes.

    For the parameters see `distortion_vectors`.
    """
    nx, ny = (max(3, round(VECTORS_ALONG * side / max(chip.size))) for side in chip.size)
    return distortion_vectors(solution, part=part, grid=(nx, ny), epoch=epoch, chip=chip.number)


def _similarity(place: Place, polynomial: Float, pixels: Float) -> tuple[Float, str]:
    """Linear map from pixels to which the distortion is relative, and a note that describes it.

    It is the identity, or the scale, rotation and parity that best map pixels to positions in a
    least-squares fit over the whole area of the detector about the reference pixel. `polynomial`
    and `pixels` are the Legendre coefficients (2, K) of positions and pixels, respectively.
    """
    w, z = (coefficients[0] + 1j * coefficients[1] for coefficients in (polynomial, pixels))
    weight = place.basis.mean_squares
    norm = weight @ np.abs(z) ** 2
    straight, flipped = (
        complex(np.sum(weight * w * pixel_plane) / norm) for pixel_plane in (z.conj(), z)
    )
    mirrored = abs(straight) < abs(flipped)
    turn = flipped if mirrored else straight
    if turn == 0:
        raise InputError(
            "the solution has no linear part to compare the distortion with",
            where=f"chip {place.chip.number}",
            do="check its coefficients",
        )
    if place.model.unit == "pix" and not mirrored and abs(turn - 1.0) < NEAR_IDENTITY:
        return np.eye(2), "relative to the array position itself, with zero at the reference pixel"
    note = (
        "relative to the best similarity about the reference pixel: "
        f"scale {abs(turn):.6g} {place.model.unit}/pixel, rotation "
        f"{np.degrees(np.angle(turn)):.3f} deg, parity {-1 if mirrored else 1:+d}"
    )
    return turn_matrix(turn, mirrored=mirrored), note
