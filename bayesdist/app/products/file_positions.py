"""Positions of pixels as the users of calibration files get them."""

from __future__ import annotations

import warnings

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS, FITSFixedWarning
from numpy.typing import NDArray

from bayesdist.calibration.plane import ARCSEC
from bayesdist.data.sky.tangent import tangent_plane
from bayesdist.products import SipHeader, sip_header

__all__ = ["sip_positions", "sky_of_header"]

Float = NDArray[np.float64]


def sip_positions(
    sip: SipHeader,
    x: Float,
    y: Float,
    *,
    unit: str,
    scale_arcsec: float | None,
    like: SipHeader | None = None,
    tangent_point: tuple[float, float] | None = None,
) -> Float:
    """(u, v) of FITS 1-based pixels (N,) by the forward terms of a header, shape (N, 2).

    `scale_arcsec` is that of a pixel as the header was made with, for u and v in pixels; CD and
    zero point of `like` hold for a file that states neither; with a `tangent_point` (sky position
    of u, v = 0) the way is over the sky, as astropy.wcs has it.
    """
    if tangent_point is not None:
        plane = tangent_plane(*sky_of_header(sip_header(sip), x, y), tangent_point)
        return np.stack(plane, axis=-1) / ARCSEC[unit]
    stated = like or sip
    in_unit = 3600.0 / (ARCSEC[unit] if unit != "pix" else scale_arcsec or 1.0)
    offset = stated.offset or (0.0, 0.0)
    return np.stack(sip.forward(x, y), axis=-1) @ (in_unit * stated.cd).T + offset


def sky_of_header(header: fits.Header, x: Float, y: Float) -> tuple[Float, Float]:
    """RA and Dec (N,) in degrees of pixels by a header, as astropy.wcs has them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        ra, dec = WCS(header).all_pix2world(x, y, 1)
    return np.asarray(ra), np.asarray(dec)
