"""Plane of the positions (u, v) of a calibration, and its orientation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.data.tangent import is_on_plane, sky_of_plane, tangent_jacobian, tangent_plane
from bayesdist.infer.solution.solution import Solution
from bayesdist.utils.arrays import Float

ARCSEC = {"arcsec": 1.0, "mas": 1e-3, "deg": 3600.0}


def arcsec_per(unit: str, scale_arcsec: float | None) -> float:
    """Arcseconds per unit of u and v; pixels of unknown size are treated as arcseconds.

    `scale_arcsec` is the size of a pixel in arcsec, if it is known.
    """
    return ARCSEC[unit] if unit != "pix" else (scale_arcsec or 1.0)


PARAMETERS = ("shift_x", "shift_y", "log_scale", "angle")


@dataclass(frozen=True)
class Agreement:
    """Residual distances between two maps of a chip after the best similarity is applied."""

    rms: float  # over the area of the chip, mas
    worst: float  # largest on a grid, mas


@dataclass(frozen=True, eq=False)
class Orientation:
    """Similarity from (u, v) to the axes (X, Y) of an aperture, with its error.

        X + i Y = shift + scale exp(i angle) (u + i v)

    A distortion solution does not determine this similarity, since the roll angle of the telescope
    is unknown to the fit.  It is taken from a reference.  Its error is common to all chips, filters
    and dates, and is described by four parameters: two shifts, the logarithm of the scale, and the
    angle.  Their covariance is the sum of the contributions of the solution and of the reference.
    """

    angle: float  # radians, positive from X to Y
    scale: float  # arcsec per unit of u and v
    shift: Float  # (2,), (X, Y) of (u, v) = (0, 0), arcsec
    v2v3: tuple[float, float]  # V2 and V3 of (X, Y) = (0, 0), arcsec
    reference_cov: Float  # (4, 4), part due to the reference: shift_x, shift_y, log_scale, angle
    derivative: Float  # (4, D), of these four with respect to the parameters of `base`
    base: Solution  # solution without frames that was compared with the reference
    source: str  # description of the reference, as a clause for HISTORY in files
    agreement: Agreement

    @property
    def cov(self) -> Float:
        """Covariance (4, 4) of shift_x, shift_y [arcsec], log_scale and angle [rad]."""
        from_solution = self.derivative @ np.asarray(self.base.cov, float) @ self.derivative.T
        return from_solution + self.reference_cov

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviations of shift_x, shift_y [arcsec], log_scale and angle [rad], by name."""
        deviations = np.sqrt(np.maximum(np.diag(self.cov), 0.0)).tolist()
        return dict(zip(PARAMETERS, deviations, strict=True))


@dataclass(frozen=True, eq=False)
class Plane:
    """Plane of the positions (u, v).

    The kind is 'free' if shift and rotation are undefined; 'sky' for a tangent plane; 'detector'
    for corrected pixels about the reference pixel; and 'aperture' for the axes of an aperture with
    a known position in V2, V3.
    """

    kind: str = "free"
    point: tuple[float, float] | None = None  # RA and Dec of (u, v) = (0, 0), degrees
    v2v3: tuple[float, float] | None = None  # V2, V3 of (u, v) = (0, 0), arcsec
    v3_angle: float | None = None  # V3IdlYAngle: degrees from +V3 to +v, positive towards +V2
    parity: int | None = None  # VIdlParity: -1 if u is opposite to V2 at an angle of zero
    orientation: Orientation | None = None  # its error is common to all calibrations that have it
    note: str = ""  # note for users

    @property
    def to_v2v3(self) -> Float | None:
        """Matrix (2, 2) from (u, v) [arcsec] to offsets in V2, V3; None if unknown.

        This is the plane approximation that is used in distortion reference files.
        """
        if self.v3_angle is None or self.parity is None:
            return None
        c, s = np.cos(np.radians(self.v3_angle)), np.sin(np.radians(self.v3_angle))
        return np.array([[self.parity * c, s], [-self.parity * s, c]])


@dataclass(frozen=True, eq=False)
class SkyPlacement:
    """Tangent point on the sky of a plane (u, v), and the directions of its axes.

    (xi, eta) = matrix (u, v) are standard coordinates in arcsec: xi increases to the east and eta
    to the north.
    """

    point: tuple[float, float]  # RA and Dec of (u, v) = (0, 0), degrees
    matrix: Float  # (2, 2), arcsec per unit of u and v

    def sky(self, plane: Float) -> tuple[Float, Float]:
        """Right ascension and declination (N,) in degrees of positions (2, N) on the plane."""
        (a, b), (c, d) = self.matrix
        u, v = plane
        return sky_of_plane(a * u + b * v, c * u + d * v, self.point)

    def plane(self, ra: Float, dec: Float) -> Float:
        """Positions (2, N) on the plane of sky positions (N,) in degrees.

        The result is NaN at 90 degrees or more from the tangent point.
        """
        out = np.full((2, *np.shape(ra)), np.nan)
        visible = is_on_plane(ra, dec, self.point)
        out[:, visible] = np.linalg.solve(
            self.matrix, np.stack(tangent_plane(ra[visible], dec[visible], self.point))
        )
        return out

    def steps(self, ra: Float, dec: Float) -> Float:
        """Derivatives (N, 2, 2) of the offsets to east and north [mas] with respect to (u, v).

        The result is NaN if RA is NaN.
        """
        out = np.full((*np.shape(ra), 2, 2), np.nan)
        finite = np.isfinite(ra)
        back = np.linalg.inv(tangent_jacobian(ra[finite], dec[finite], self.point))
        out[finite] = 1e3 * (back @ self.matrix)
        return out
