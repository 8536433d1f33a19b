"""How a solution lies in V2 and V3: the similarity from (u, v) to the plane of an IDCTAB.

    Xc + i Yc = shift + scale exp(i angle) (u + i v)
    V2 = V2_0 + p0 Xc,   V3 = V3_0 + p1 Yc

A distortion solution fixes everything but this: the fit cannot know how the telescope was rolled.
The similarity comes from a reference, and with it an error that all chips, filters and dates
share.  It is carried as four parameters (two shifts, logarithm of the scale, angle) whose
covariance has two parts: what they inherit from the solution, and the reference's own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.solution import Solution
from bayesdist.calibration.plane import ARCSEC
from bayesdist.errors import InputError

__all__ = [
    "PARAMETERS",
    "Agreement",
    "Orientation",
    "check_epoch",
    "check_frames",
    "cov_about",
    "held_scale",
    "mirrored",
]

Float = NDArray[np.float64]

PARAMETERS = ("shift_x", "shift_y", "log_scale", "angle")


@dataclass(frozen=True, eq=False)
class Agreement:
    """How far two maps of one chip differ when the similarity between them is taken out.

    Parameters
    ----------
    rms, worst : float
        Of the length of the difference: root mean square over the area of the chip, and largest
        value on the grid; mas.
    x, y : ndarray, shape (N,)
        Grid of pixels, FITS 1-based.
    difference : ndarray, shape (N, 2)
        Reference minus solution, (Xc, Yc) in mas.
    """

    rms: float
    worst: float
    x: Float
    y: Float
    difference: Float


@dataclass(frozen=True, eq=False)
class Orientation:
    """The similarity that brings (u, v) to (Xc, Yc) of an IDCTAB, and how well it is known.

    Parameters
    ----------
    angle : float
        Rotation from (u, v) to (Xc, Yc), radians, positive from Xc to Yc.
    scale : float
        Arcseconds in one unit of u, v.
    shift : ndarray, shape (2,)
        (Xc, Yc) of (u, v) = (0, 0), arcseconds.
    v2v3 : tuple of float
        V2 and V3 of (Xc, Yc) = (0, 0), arcseconds.
    reference_cov : ndarray, shape (4, 4)
        Covariance of shift_x, shift_y, log_scale and angle that the reference brings in.
    derivative : ndarray, shape (4, D)
        Derivatives of these four by the parameters of `base`.
    base : Solution
        The solution that was laid on the reference.
    source : str
        What the reference was, as a clause for the file's HISTORY.
    agreement : Agreement or None
        None where the reference is no map but a point and a direction.
    """

    angle: float
    scale: float
    shift: Float
    v2v3: tuple[float, float]
    reference_cov: Float
    derivative: Float
    base: Solution
    source: str
    agreement: Agreement | None = None

    @property
    def cov(self) -> Float:
        """Covariance (4, 4) of shift_x, shift_y [arcsec], log_scale and angle [rad]."""
        own = self.derivative @ np.asarray(self.base.cov, float) @ self.derivative.T
        return own + self.reference_cov

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviations, under the names of `PARAMETERS`."""
        return dict(
            zip(PARAMETERS, np.sqrt(np.maximum(np.diag(self.cov), 0.0)).tolist(), strict=True)
        )


# -- what all ways to find one share --------------------------------------------------------------


def check_frames(solution: Solution) -> None:
    """Refuse a solution that has no one frame for all exposures."""
    if solution.model.frames != "none":
        raise InputError(
            "the solution has a frame for each exposure, and V2, V3 need one for all",
            where="model.frames",
            do="take it in the reference gauge first (bayesdist.infer.views)",
        )


def check_epoch(solution: Solution, epoch: float | None) -> None:
    """Refuse a missing date where the polynomials depend on it."""
    if solution.model.time is not None and epoch is None:
        raise InputError(
            "the solution depends on time and no epoch is given",
            where="epoch",
            do="give the decimal year at which it is laid on the reference",
        )


def held_scale(unit: str, scale_arcsec: float | None) -> float | None:
    """Arcseconds in one unit of u, v, or None where it is to be fitted."""
    if scale_arcsec is None:
        return None if unit == "pix" else ARCSEC[unit]
    if not (np.isfinite(scale_arcsec) and scale_arcsec > 0):
        raise InputError(
            f"the scale is {scale_arcsec}", where="scale_arcsec", do="give a positive number"
        )
    return float(scale_arcsec)


def mirrored(where: str) -> InputError:
    """The error for (u, v) that no rotation brings onto (Xc, Yc)."""
    return InputError(
        "u, v are mirrored against the detector's x, y",
        where=where,
        do="let u run with x and v with y, or change the sign of one of them",
    )


def cov_about(arm: complex, variance: float, log_scale: float, angular: float) -> Float:
    """Covariance of the four parameters from independent errors at a point.

    The shift holds at (u, v) = (0, 0), which lies at -`arm` from the point where position, scale
    and angle are independent.
    """
    to_origin = np.eye(4)
    to_origin[:2, 2] = -arm.real, -arm.imag
    to_origin[:2, 3] = arm.imag, -arm.real
    return to_origin @ np.diag([variance, variance, log_scale, angular]) @ to_origin.T
