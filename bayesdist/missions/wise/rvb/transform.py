"""Linear transformations of RvB pairs, also from one set of frame solutions to another.

This corresponds to TRSrvb and RERrvb in WSDC D-T033, section 3: transformations with up to five
parameters (two shifts, a rotation, two scales), and the change from frame solutions with free
scales to those with fixed scales.  The sixth parameter of a solution is the skew, which is zero in
gnDSTR of the report.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int

PARAMETERS = ("shift_u", "shift_v", "rotation", "scale_u", "scale_v", "skew")

# Errors of u and v are uncorrelated in Matches, so that a transformation that would correlate them


@dataclass(frozen=True)
class RvbTransform:
    """Linear transformation (u, v) -> centre + shift + R K S ((u, v) - centre).

    R rotates by `rotation` from u towards v, S scales by 1 + scale_u and 1 + scale_v, and
    K = [[1, skew], [0, 1]].

    Raises InputError if a value is not finite or a scale is not above -1.
    """

    shift_u: float = 0.0  # in the unit of u and v
    shift_v: float = 0.0
    rotation: float = 0.0  # radians
    scale_u: float = 0.0  # scale minus 1
    scale_v: float = 0.0
    skew: float = 0.0  # radians
    # fixed point of rotation and scales; by default the centre of a W1 array
    centre: tuple[float, float] = (508.5, 508.5)

    def __post_init__(self) -> None:
        for name, value in zip(PARAMETERS, self.values, strict=True):
            if not np.isfinite(value) or (name.startswith("scale") and value <= -1.0):
                raise InputError(
                    f"{name} of a linear transformation is {value:g}",
                    do="give a finite number, and scales above -1",
                )

    @property
    def values(self) -> Float:
        """The six parameters in the order of `PARAMETERS`."""
        return np.array(astuple(self)[:6], float)

    @property
    def matrix(self) -> Float:
        """Matrix R K S, shape (2, 2)."""
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        upper = np.array([[1.0, self.skew], [0.0, 1.0]])
        return np.array([[c, -s], [s, c]]) @ upper * [1 + self.scale_u, 1 + self.scale_v]

    @property
    def shift(self) -> Float:
        """Shifts along u and v, shape (2,)."""
        return np.array([self.shift_u, self.shift_v])

    def __call__(self, points: ArrayLike) -> Float:
        """Transform points (..., 2)."""
        offset = np.asarray(points, float) - self.centre
        return offset @ self.matrix.T + self.centre + self.shift

    def jacobian(self) -> Float:
        """Derivatives (6, 6) of shift and matrix with respect to the parameters.

        The rows are both shifts, then the matrix by rows; the columns are in the order of
        `PARAMETERS`.
        """
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        rotation, rotation_derivative = np.array([[c, -s], [s, c]]), np.array([[-s, -c], [c, -s]])
        scale = np.diag([1 + self.scale_u, 1 + self.scale_v])
        upper = np.array([[1.0, self.skew], [0.0, 1.0]])
        out = np.zeros((6, 6))
        out[:2, :2] = np.eye(2)
        for column, derivative in enumerate(
            (
                rotation_derivative @ upper @ scale,
                rotation @ upper @ np.diag([1.0, 0.0]),
                rotation @ upper @ np.diag([0.0, 1.0]),
                rotation @ np.array([[0.0, 1.0], [0.0, 0.0]]) @ scale,
            ),
            2,
        ):
            out[2:, column] = derivative.ravel()
        return out


def transformed(matches: Matches, transform: RvbTransform) -> Matches:
    """Transform the reference positions of pairs and the covariances of their errors."""
    everywhere = np.zeros(len(matches), np.int64)
    return _moved(matches, everywhere, transform.matrix[None], transform.shift[None],
                  np.array([transform.centre]))  # fmt: skip


def rereference(
    matches: Matches,
    free: Mapping[str, RvbTransform],
    fixed: Mapping[str, RvbTransform],
) -> Matches:
    """Transform pairs from one set of frame solutions to another.

    The reference positions of a frame are the nominal pixels of its stars, transformed to the band
    frame with the solution of the frame.  A solution with free scales absorbs a part of the
    distortion that differs from frame to frame, so that the linear terms of a calibration are
    meaningless.  With fixed scales they are meaningful, as are shifts and rotations between bands.
    The pairs alone do not show what a free solution absorbed, so that both solutions must be given.

    Parameters
    ----------
    matches : Matches
        Pairs that were made with the free solutions.
    free, fixed : mapping of str to RvbTransform
        Solutions of each frame, from the common nominal pixels to the band frame.  If the frame was
        solved in another band, the solution must include the translation and rotation between the
        bands.

    Returns
    -------
    Matches

    Raises
    ------
    InputError
        If a frame has no solution, or errors would become correlated (see `transformed`).
    """
    moves = []
    used, code = np.unique(matches.exposure, return_inverse=True)
    for name in (matches.exposure_names[k] for k in used):
        for kind, solutions in (("free", free), ("fixed", fixed)):
            if name not in solutions:
                raise InputError(
                    f"frame {name!r} has no solution with {kind} scales",
                    where=", ".join(matches.sources),
                    do="give the solutions of all frames, or remove its pairs",
                )
        old, new = free[name], fixed[name]
        # inverse of the old solution followed by the new one, as one map about the old centre
        matrix = new.matrix @ np.linalg.inv(old.matrix)
        away = np.subtract(old.centre, new.centre)
        moves.append(
            (matrix, new.shift + new.matrix @ away - away - matrix @ old.shift, old.centre)
        )
    return _moved(matches, code, *map(np.array, zip(*moves, strict=True)))


def _moved(matches: Matches, code: Int, matrix: Float, shift: Float, centre: Float) -> Matches:
    """Transform each pair with the linear map given by its code."""

    def moved(u: Float, v: Float) -> Float:
        points = np.stack([u, v])
        offset = points.T - centre[code]
        # the change is added, so that the identity is exact
        change = np.einsum("nij,nj->ni", (matrix - np.eye(2))[code], offset) + shift[code]
        return points + change.T

    columns = dict(zip(("u", "v"), moved(matches.u, matches.v), strict=True))
    if matches.u_nominal is not None and matches.v_nominal is not None:
        nominal = moved(matches.u_nominal, matches.v_nominal)
        columns |= dict(zip(("u_nominal", "v_nominal"), nominal, strict=True))
    if matches.sigma_u is not None:
        M = matrix[code]
        matches = matches.with_covariances(M @ matches.covariances() @ np.swapaxes(M, 1, 2))
    return matches.with_columns(**columns)
