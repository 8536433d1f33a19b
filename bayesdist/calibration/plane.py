"""The plane that a calibration maps to, and how it was laid there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.transforms import Solution

__all__ = ["ARCSEC", "Agreement", "Orientation", "Plane"]

Float = NDArray[np.float64]

ARCSEC = {"arcsec": 1.0, "mas": 1e-3, "deg": 3600.0}

PARAMETERS = ("shift_x", "shift_y", "log_scale", "angle")


@dataclass(frozen=True)
class Agreement:
    """Distances between two maps of one chip when the similarity between them is taken out.

    Parameters
    ----------
    rms, worst : float
        Root mean square over the area of the chip, and largest on a grid; mas.
    """

    rms: float
    worst: float


@dataclass(frozen=True, eq=False)
class Orientation:
    """The similarity that brings (u, v) to the axes (X, Y) of an aperture, with its error.

        X + i Y = shift + scale exp(i angle) (u + i v)

    A distortion solution fixes everything but this: the fit cannot know how the telescope was
    rolled.  The similarity comes from a reference, and with it an error that all chips, filters and
    dates share: four parameters (two shifts, logarithm of the scale, angle) whose covariance has
    two parts, what they inherit from the solution, and the reference's own.

    Parameters
    ----------
    angle : float
        Radians, positive from X to Y.
    scale : float
        Arcseconds in one unit of u, v.
    shift : ndarray, shape (2,)
        (X, Y) of (u, v) = (0, 0), arcseconds.
    v2v3 : tuple of float
        V2 and V3 of (X, Y) = (0, 0), arcseconds.
    reference_cov : ndarray, shape (4, 4)
        Covariance of shift_x, shift_y, log_scale and angle that the reference brings in.
    derivative : ndarray, shape (4, D)
        Derivatives of these four by the parameters of `base`.
    base : Solution
        The solution that was laid on the reference, without frames of exposures.
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
        """Standard deviations, by name."""
        deviations = np.sqrt(np.maximum(np.diag(self.cov), 0.0)).tolist()
        return dict(zip(PARAMETERS, deviations, strict=True))


@dataclass(frozen=True, eq=False)
class Plane:
    """The plane of (u, v).

    Parameters
    ----------
    kind : {'free', 'sky', 'detector', 'aperture'}
        'free': up to shift and rotation; 'sky': about a tangent point; 'detector': corrected pixels
        about the reference pixel; 'aperture': along the axes of an aperture, whose place in V2, V3
        is known.
    point : tuple of float, optional
        RA and Dec of (u, v) = 0, degrees.
    v2v3 : tuple of float, optional
        V2 and V3 of (u, v) = 0, arcseconds.
    orientation : Orientation, optional
        How the calibration was laid there; calibrations with the same one share its error.
    note : str
        What a reader has to know of it.
    """

    kind: str = "free"
    point: tuple[float, float] | None = None
    v2v3: tuple[float, float] | None = None
    orientation: Orientation | None = None
    note: str = ""
