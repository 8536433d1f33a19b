"""Two exposures of one field laid on each other: what their calibration leaves between them.

The test of ACS ISR 2015-06, section 6: corrected positions of the same stars differ by a shift, a
rotation and a scale if the calibration is right, and by a pattern if it is not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.sky.tangent import mean_direction, tangent_plane
from bayesdist.errors import DegenerateError, InputError

__all__ = ["Alignment", "PixelToSky", "alignment_residuals"]

Float = NDArray[np.float64]


class PixelToSky(Protocol):
    """Method of a WCS that is needed: astropy.wcs.WCS and stwcs' HSTWCS have it."""

    def all_pix2world(self, pixels: Any, origin: int, /) -> Any:
        """Right ascension and declination (N, 2), degrees, of pixels (N, 2)."""
        ...


@dataclass(frozen=True, eq=False)
class Alignment:
    """The similarity between two exposures, and what it leaves.

        a = shift + scale R(rotation) b

    of positions on the tangent plane at the mean direction of the stars in exposure a.

    Parameters
    ----------
    shift : ndarray, shape (2,)
        Pixels.
    rotation : float
        Radians, from xi to eta.
    scale : float
    position : ndarray, shape (N, 2)
        (xi, eta) of the stars in exposure a, pixels.
    residual : ndarray, shape (N, 2)
        a minus the transformed b, pixels.
    """

    shift: Float
    rotation: float
    scale: float
    position: Float
    residual: Float

    @property
    def rms(self) -> Float:
        """Root mean square residual of each axis, shape (2,), pixels."""
        return np.sqrt(np.mean(self.residual**2, axis=0))


def alignment_residuals(
    wcs_a: PixelToSky,
    wcs_b: PixelToSky,
    xy_a: ArrayLike,
    xy_b: ArrayLike,
    *,
    pixel_arcsec: float = 0.05,
) -> Alignment:
    """Fit shift, rotation and scale between the corrected positions of the same stars.

    Parameters
    ----------
    wcs_a, wcs_b : WCS
        Of each exposure.
    xy_a, xy_b : array_like, shape (N, 2)
        FITS 1-based pixels of the same N stars.
    pixel_arcsec : float
        Arcseconds of the pixels in which the result is stated: those of the drizzled image.

    Returns
    -------
    Alignment
        Every star counts alike and none is clipped: the fit is that of `tweakwcs.fit_rscale`.

    Raises
    ------
    InputError
        For lists of different length, fewer than three stars, and positions that are not finite.
    DegenerateError
        When all stars of an exposure are at one place.
    """
    sky_a, sky_b = (
        _sky(wcs, xy, name) for wcs, xy, name in ((wcs_a, xy_a, "a"), (wcs_b, xy_b, "b"))
    )
    if len(sky_a) != len(sky_b):
        raise InputError(
            f"there are {len(sky_a)} stars in exposure a and {len(sky_b)} in exposure b",
            where="xy_a, xy_b",
            do="give the same stars in the same order",
        )
    if len(sky_a) < 3:
        raise InputError(
            f"{len(sky_a)} stars leave nothing to judge by", where="xy_a", do="give three or more"
        )
    point = mean_direction(*sky_a.T)
    planes = (tangent_plane(sky[:, 0], sky[:, 1], point) for sky in (sky_a, sky_b))
    a, b = ((xi + 1j * eta) / pixel_arcsec for xi, eta in planes)
    za, zb = a - a.mean(), b - b.mean()
    spread = float(np.sum(np.abs(zb) ** 2))
    if spread == 0:
        raise DegenerateError("all stars are at one place", where="xy_b", do="give other stars")
    turn = complex(np.sum(np.conj(zb) * za)) / spread
    shift = a.mean() - turn * b.mean()
    residual = a - shift - turn * b
    return Alignment(
        shift=np.array([shift.real, shift.imag]),
        rotation=float(np.angle(turn)),
        scale=abs(turn),
        position=np.stack([a.real, a.imag], axis=1),
        residual=np.stack([residual.real, residual.imag], axis=1),
    )


def _sky(wcs: PixelToSky, xy: ArrayLike, name: str) -> Float:
    """Right ascension and declination (N, 2), degrees, of pixels (N, 2)."""
    xy = np.asarray(xy, float)
    if xy.ndim != 2 or xy.shape[1] != 2 or not np.isfinite(xy).all():
        raise InputError(
            "the pixels are no finite array (N, 2)", where=f"xy_{name}", do="give x and y of each"
        )
    return np.asarray(wcs.all_pix2world(xy, 1), float)
