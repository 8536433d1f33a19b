"""The distortion as vectors over the detector."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import legendre

from bayesdist.arrays import Float
from bayesdist.assess.solution import Place, Solution, place_of
from bayesdist.errors import InputError, require_known
from bayesdist.model.basis import point_blocks
from bayesdist.model.grid import DEFAULT_GRID, grid_pixels, mesh, position_of_largest

PARTS = ("no_constant", "non_linear")

# u, v in pixels count as positions on the array itself when the best similarity is as near to the
# identity as this (scale 0.9 to 1.1, rotation below 6 degrees).
NEAR_IDENTITY = 0.1


@dataclass(frozen=True, eq=False)
class VectorMap:
    """Displacement vectors over the detector.

    Parameters
    ----------
    x : ndarray, shape (nx,)
    y : ndarray, shape (ny,)
        FITS 1-based pixels.
    du, dv : ndarray, shape (ny, nx)
        Displacement along u and v, in `unit`.
    unit : str
    part : str
        One of `PARTS`.
    part_note : str
        What the displacement is relative to, for people.
    similarity : ndarray, shape (2, 2)
        Linear map from pixel offsets to offsets in (u, v): the identity where u, v lie along the
        pixel axes, else the best scale, rotation and parity.
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
        """Largest length."""
        return float(self.length.max())

    @property
    def position_of_max(self) -> tuple[float, float]:
        """Pixel (x, y) of the largest length."""
        return position_of_largest(self.length, self.x, self.y)

    @property
    def on_detector(self) -> tuple[Float, Float]:
        """The vectors along the detector's x and y, (ny, nx) each, in pixels.

        These are what a diagram over the detector shows; they equal (du, dv) where `similarity` is
        the identity.
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
    """The distortion of a solution's mean, without constant or without its linear part.

    Parameters
    ----------
    solution : LinearFit or Posterior
    grid : tuple of int
        Points on x and y.
    part : str
        'no_constant': from the array position to the corrected position, the zeroth order (the
        value at the reference pixel) suppressed, as the diagrams in section 4 of WSDC D-T033.
        Where u, v are angles, or pixels of rotated or flipped axes, the array position is first
        taken through the similarity (scale, rotation, parity) that fits best over the detector.
        'non_linear': the terms of order 2 and more about the reference pixel, as Figure 4.1 of
        section 4.1 of the ACS handbook.
    epoch : float, optional
        Decimal years; needed by a model with time dependence.
    chip : int, optional
        Chip number; the first chip by default.

    Returns
    -------
    VectorMap

    Raises
    ------
    InputError
        For an unknown part or chip, a missing epoch, a bad grid, or a solution without linear part.
    """
    require_known(part, PARTS, "part of the distortion", where="part")
    place = place_of(solution.model, epoch=epoch, chip=chip)
    polynomial = place.polynomial(solution.mean)
    similarity, note = _reference(place, polynomial)
    if part == "non_linear":
        linear = _linear_part(place, polynomial)
        note = "the terms of order 2 and more about the reference pixel"
    else:
        linear = similarity
    xref, yref = place.chip.reference_pixel
    at_reference = polynomial @ place.basis.evaluate([xref], [yref])[0]
    x, y = grid_pixels(place.chip.size, grid)
    X, Y = mesh(x, y)
    d = np.empty((2, X.size))
    for rows in point_blocks(X.size):
        w = polynomial @ place.basis.evaluate(X[rows], Y[rows]).T
        offset = np.stack([X[rows] - xref, Y[rows] - yref])
        d[:, rows] = w - at_reference[:, None] - linear @ offset
    return VectorMap(
        x=x,
        y=y,
        du=d[0].reshape(y.size, x.size),
        dv=d[1].reshape(y.size, x.size),
        unit=solution.model.unit,
        part=part,
        part_note=note,
        similarity=similarity,
    )


def _linear_part(place: Place, polynomial: Float) -> Float:
    """Matrix d(u, v) / d(x, y) at the reference pixel."""
    px, py = place.basis.gradient(*np.array(place.chip.reference_pixel)[:, None])
    return np.concatenate([polynomial @ px.T, polynomial @ py.T], axis=1)


def _reference(place: Place, polynomial: Float) -> tuple[Float, str]:
    """Positions that distortion is shown against, by identity or best similarity, and a note."""
    scale, angle, parity = _best_similarity(place, polynomial)
    turn = scale * np.exp(1j * angle)
    if place.model.unit == "pix" and parity > 0 and abs(turn - 1.0) < NEAR_IDENTITY:
        return np.eye(2), "relative to the array position itself, with zero at the reference pixel"
    flip = np.diag([1.0, parity])
    matrix = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]]) @ flip
    note = (
        "relative to the best similarity about the reference pixel: "
        f"scale {scale:.6g} {place.model.unit}/pixel, rotation {np.degrees(angle):.3f} deg, "
        f"parity {parity:+d}"
    )
    return matrix, note


def _best_similarity(place: Place, polynomial: Float) -> tuple[float, float, int]:
    """Scale, rotation (radians) and parity that bring pixel offsets nearest to (u, v).

    Least squares over the whole area of the detector, about the reference pixel: Gauss-Legendre
    nodes make the integrals exact, so that the answer does not depend on the grid shown.
    """
    nodes, weights = legendre.leggauss(place.model.order + 1)
    nx, ny = place.chip.size
    X, Y = mesh((nodes * nx + nx + 1.0) / 2.0, (nodes * ny + ny + 1.0) / 2.0)
    weight = np.outer(weights, weights).ravel()
    xref, yref = place.chip.reference_pixel
    values = place.basis.evaluate(np.append(X, xref), np.append(Y, yref)) @ polynomial.T
    u, v = (values[:-1] - values[-1]).T
    z, w = (X - xref) + 1j * (Y - yref), u + 1j * v
    norm = np.sum(weight * np.abs(z) ** 2)
    straight = np.sum(weight * w * z.conj()) / norm
    flipped = np.sum(weight * w * z) / norm
    best, parity = (straight, 1) if abs(straight) >= abs(flipped) else (flipped, -1)
    if best == 0:
        raise InputError(
            "the solution has no linear part to compare the distortion with",
            where=f"chip {place.chip.number}",
            do="check its coefficients",
        )
    return float(np.abs(best)), float(np.angle(best)), parity
