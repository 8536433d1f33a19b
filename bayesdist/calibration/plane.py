"""Plane that a calibration maps to, and its orientation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.data.sky.tangent import (
    is_on_plane,
    sky_of_plane,
    tangent_jacobian,
    tangent_plane,
)
from bayesdist.infer.solution.solution import Solution
from bayesdist.utils.arrays import Float

ARCSEC = {"arcsec": 1.0, "mas": 1e-3, "deg": 3600.0}


def arcsec_per(unit: str, scale_arcsec: float | None) -> float:
    """Arcseconds in one unit of (u, v); pixels of unknown size count as arcseconds."""
    return ARCSEC[unit] if unit != "pix" else (scale_arcsec or 1.0)


PARAMETERS = ("shift_x", "shift_y", "log_scale", "angle")


@dataclass(frozen=True)
class Agreement:
    """Distances between two maps of one chip when the similarity between them is taken out."""

    rms: float  # over the area of the chip, mas
    worst: float  # on a grid, mas


@dataclass(frozen=True, eq=False)
class Orientation:
    """Similarity from (u, v) to the axes (X, Y) of an aperture, with its error.

        X + i Y = shift + scale exp(i angle) (u + i v)

    A distortion solution fixes everything but this: the fit cannot know how the telescope was
    rolled.  The similarity comes from a reference, and with it an error that all chips, filters and
    dates have in common: four parameters (two shifts, logarithm of the scale, angle) whose
    covariance is the sum of that inherited from the solution and the reference's own.
    """

    angle: float  # radians, positive from X to Y
    scale: float  # arcseconds in one unit of u, v
    shift: Float  # (2,), (X, Y) of (u, v) = (0, 0), arcsec
    v2v3: tuple[float, float]  # V2 and V3 of (X, Y) = (0, 0), arcsec
    reference_cov: Float  # (4, 4), the reference's, of shift_x, shift_y, log_scale, angle
    derivative: Float  # (4, D), of these four by the parameters of `base`
    base: Solution  # solution without frames that was laid on the reference
    source: str  # the reference, as a clause for the file's HISTORY
    agreement: Agreement

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
    """Plane of (u, v).

    'free' is up to shift and rotation; 'sky' about a tangent point; 'detector' has corrected pixels
    about the reference pixel; 'aperture' is along the axes of an aperture, whose position in V2, V3
    is known.
    """

    kind: str = "free"
    point: tuple[float, float] | None = None  # RA and Dec of (u, v) = 0, degrees
    v2v3: tuple[float, float] | None = None  # of (u, v) = 0, arcsec
    v3_angle: float | None = None  # degrees from +V3 to +v, positive towards +V2: V3IdlYAngle
    parity: int | None = None  # -1 where u runs against V2 at an angle of zero: VIdlParity
    orientation: Orientation | None = None  # calibrations with one have its error in common
    note: str = ""  # for the reader

    @property
    def to_v2v3(self) -> Float | None:
        """Matrix (2, 2) from (u, v) [arcsec] to offsets in V2, V3; None where it is not known.

        In the plane approximation, as distortion reference files have it.
        """
        if self.v3_angle is None or self.parity is None:
            return None
        c, s = np.cos(np.radians(self.v3_angle)), np.sin(np.radians(self.v3_angle))
        return np.array([[self.parity * c, s], [-self.parity * s, c]])


@dataclass(frozen=True, eq=False)
class SkyPlacement:
    """Tangent point of a plane (u, v) on the sky, and the directions of its axes there.

    (xi, eta) = matrix (u, v) are standard coordinates in arcsec: xi increases to the east and eta
    to the north.
    """

    point: tuple[float, float]  # RA and Dec of (u, v) = 0, degrees
    matrix: Float  # (2, 2), arcsec in one unit of u, v

    def sky(self, plane: Float) -> tuple[Float, Float]:
        """Right ascension and declination (N,) in degrees of positions (2, N) of the plane."""
        (a, b), (c, d) = self.matrix
        u, v = plane
        return sky_of_plane(a * u + b * v, c * u + d * v, self.point)

    def plane(self, ra: Float, dec: Float) -> Float:
        """Positions (2, N) on the plane; NaN 90 degrees or more from the tangent point."""
        out = np.full((2, *np.shape(ra)), np.nan)
        seen = is_on_plane(ra, dec, self.point)
        out[:, seen] = np.linalg.solve(
            self.matrix, np.stack(tangent_plane(ra[seen], dec[seen], self.point))
        )
        return out

    def steps(self, ra: Float, dec: Float) -> Float:
        """Steps (N, 2, 2) to the east and north, in mas, per unit of u, v; NaN where RA is NaN."""
        out = np.full((*np.shape(ra), 2, 2), np.nan)
        known = np.isfinite(ra)
        back = np.linalg.inv(tangent_jacobian(ra[known], dec[known], self.point))
        out[known] = 1e3 * (back @ self.matrix)
        return out
