"""Linear transformations of RvB pairs, from one set of frame solutions to another.

What TRSrvb and RERrvb do in WSDC D-T033, section 3: up to five parameters (two shifts, a rotation,
two scales), and pairs brought from frame solutions with free scales to those with fixed ones.  The
sixth parameter of a solution is the skew, which the report's gnDSTR holds at zero.
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

# Errors of u and v stay uncorrelated in a Matches.  A transformation that correlates them by
# more than this cannot be represented; a rotation of 0.05 with errors 1 to 1.5 makes 0.04.
CORRELATED = 0.1


@dataclass(frozen=True)
class RvbTransform:
    """(u, v) -> centre + shift + R K S ((u, v) - centre).

    R turns by `rotation` from u towards v, S scales by 1 + scale_u and 1 + scale_v, and
    K = [[1, skew], [0, 1]].

    InputError for values that are not finite, and scales that leave nothing or mirror.
    """

    shift_u: float = 0.0  # in the unit of u, v
    shift_v: float = 0.0
    rotation: float = 0.0  # radians
    scale_u: float = 0.0  # relative to one, above -1
    scale_v: float = 0.0
    skew: float = 0.0  # radians
    # the point that rotation and scales leave where it is; by default the centre of a W1 array
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
        """The six parameters, in the order of `PARAMETERS`."""
        return np.array(astuple(self)[:6], float)

    @property
    def matrix(self) -> Float:
        """R K S, shape (2, 2)."""
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        upper = np.array([[1.0, self.skew], [0.0, 1.0]])
        return np.array([[c, -s], [s, c]]) @ upper * [1 + self.scale_u, 1 + self.scale_v]

    @property
    def shift(self) -> Float:
        """Both shifts, shape (2,)."""
        return np.array([self.shift_u, self.shift_v])

    def __call__(self, points: ArrayLike) -> Float:
        """Transformed points.

        `points`: (..., 2).
        """
        offset = np.asarray(points, float) - self.centre
        return offset @ self.matrix.T + self.centre + self.shift

    def jacobian(self) -> Float:
        """Derivatives of shift and matrix by the parameters.

        Returns (6, 6), rows: both shifts, then the matrix row by row; columns in the order of
        `PARAMETERS`.
        """
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        turn, turned = np.array([[c, -s], [s, c]]), np.array([[-s, -c], [c, -s]])
        scale = np.diag([1 + self.scale_u, 1 + self.scale_v])
        upper = np.array([[1.0, self.skew], [0.0, 1.0]])
        out = np.zeros((6, 6))
        out[:2, :2] = np.eye(2)
        for column, by in enumerate(
            (
                turned @ upper @ scale,
                turn @ upper @ np.diag([1.0, 0.0]),
                turn @ upper @ np.diag([0.0, 1.0]),
                turn @ np.array([[0.0, 1.0], [0.0, 0.0]]) @ scale,
            ),
            2,
        ):
            out[2:, column] = by.ravel()
        return out


def transformed(matches: Matches, transform: RvbTransform) -> Matches:
    """Pairs with their reference positions transformed, and the errors with them.

    InputError when errors of u and v would come out correlated by more than 0.1, which a table of
    matches does not hold: unequal errors turned by an angle that is neither small nor a right one.
    """
    everywhere = np.zeros(len(matches), np.int64)
    return _moved(matches, everywhere, transform.matrix[None], transform.shift[None],
                  np.array([transform.centre]))  # fmt: skip


def rereference(
    matches: Matches,
    free: Mapping[str, RvbTransform],
    fixed: Mapping[str, RvbTransform],
) -> Matches:
    """Pairs as they would be with other solutions of their frames.

    The reference positions of a frame are its stars' nominal pixels, brought to the band frame by
    the frame's solution.  A solution with free scales takes up part of the distortion, another part
    in each frame, so that linear terms of a calibration mean nothing; with scales held at one value
    they do, and so do shifts and rotations between bands.  The pairs alone cannot tell what a free
    solution took up: it has to be given.

    `matches`: made with the free solutions. `free`, `fixed`: solution of each frame: from nominal
    pixels, which are common to both, to the band frame. Those of other bands than the one that is
    solved for are its solution, then the band's translation and rotation known beforehand.
    InputError for a frame without a solution, and as `transformed`.
    """
    moves = []
    used, code = np.unique(matches.exposure, return_inverse=True)
    for name in (matches.exposure_names[k] for k in used):
        for kind, solutions in (("free", free), ("fixed", fixed)):
            if name not in solutions:
                raise InputError(
                    f"frame {name!r} has no solution with {kind} scales",
                    where=", ".join(matches.sources),
                    do="give the solutions of all frames, or leave its pairs out",
                )
        old, new = free[name], fixed[name]
        # back to nominal pixels, then on by the other solution, as one map about the first centre
        matrix = new.matrix @ np.linalg.inv(old.matrix)
        away = np.subtract(old.centre, new.centre)
        moves.append(
            (matrix, new.shift + new.matrix @ away - away - matrix @ old.shift, old.centre)
        )
    return _moved(matches, code, *map(np.array, zip(*moves, strict=True)))


def _moved(matches: Matches, code: Int, matrix: Float, shift: Float, centre: Float) -> Matches:
    """Pairs moved by a linear map each: that of its code."""

    def moved(u: Float, v: Float) -> Float:
        points = np.stack([u, v])
        offset = points.T - centre[code]
        # the change is added: an identity leaves every digit
        change = np.einsum("nij,nj->ni", (matrix - np.eye(2))[code], offset) + shift[code]
        return points + change.T

    columns = dict(zip(("u", "v"), moved(matches.u, matches.v), strict=True))
    if matches.u_nominal is not None and matches.v_nominal is not None:
        nominal = moved(matches.u_nominal, matches.v_nominal)
        columns |= dict(zip(("u_nominal", "v_nominal"), nominal, strict=True))
    if matches.sigma_u is not None and matches.sigma_v is not None:
        var = np.stack([matches.sigma_u, matches.sigma_v], axis=1) ** 2
        out = np.sqrt(np.einsum("nij,nj->ni", (matrix**2)[code], var))
        both = np.einsum("nj,nj->n", (matrix[:, 0] * matrix[:, 1])[code], var)
        correlation = np.abs(both / (out[:, 0] * out[:, 1]))
        if correlation.max() > CORRELATED:
            worst = int(np.argmax(correlation))
            raise InputError(
                f"the errors of u and v would be correlated by {correlation[worst]:.2f}",
                where=f"{matches.sources[matches.source[worst]]}, row {matches.row[worst] + 1}",
                do="give both axes the same errors before, or transform the detections instead",
            )
        columns |= {"sigma_u": out[:, 0], "sigma_v": out[:, 1]}
    return matches.with_columns(**columns)
