"""Positions of pixels as users of SIP headers obtain them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.plane import ARCSEC, arcsec_per
from bayesdist.data.sky import tangent_plane
from bayesdist.formats.sip.header import SipHeader
from bayesdist.formats.sip.read import sip_of
from bayesdist.formats.sip.write import sip_header
from bayesdist.products.common.celestial import sky_of_header
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import PARAMETERS, BuildOptions, Built
from bayesdist.products.common.read_back import ReadBack
from bayesdist.utils.arrays import Float


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
    """(u, v) of FITS 1-based pixels (N,) computed from the forward terms of a header, shape (N, 2).

    For u and v in pixels, `scale_arcsec` is the pixel scale with which the header was made. `like`
    provides CD and zero point for a file that states neither. With a `tangent_point` (sky position
    of u, v = 0), positions are computed through the sky, as in astropy.wcs.
    """
    if tangent_point is not None:
        plane = tangent_plane(*sky_of_header(sip_header(sip), x, y), tangent_point)
        return np.stack(plane, axis=-1) / ARCSEC[unit]
    stated = like or sip
    if stated.linear_axes:
        return np.stack(sip.forward(x, y), axis=-1) @ stated.cd.T + stated.crval
    in_unit = 3600.0 / arcsec_per(unit, scale_arcsec)
    offset = stated.offset or (0.0, 0.0)
    return np.stack(sip.forward(x, y), axis=-1) @ (in_unit * stated.cd).T + offset


def sip_read_back(
    files: Sequence[Built], calibration: Calibration, options: BuildOptions
) -> list[ReadBack]:
    """Positions from the headers of the chips, on the sky if the calibration has a sky plane."""
    headers = {
        built.chip: sip_of(Content(built.file_name, built.content))
        for built in files
        if built.chip is not None and built.kind != PARAMETERS
    }
    names = ", ".join(built.file_name for built in files if built.kind != PARAMETERS)
    point = calibration.plane.point
    return [headers_read_back(names, headers, calibration, options, tangent_point=point)]


def headers_read_back(
    file: str,
    headers: Mapping[int, SipHeader],
    calibration: Calibration,
    options: BuildOptions,
    *,
    like: SipHeader | None = None,
    tangent_point: tuple[float, float] | None = None,
) -> ReadBack:
    """Positions from one header per chip; for `like` and `tangent_point` see `sip_positions`."""
    unit = calibration.model.unit

    def forward(x: Float, y: Float, chip: int, _: float | None) -> Float:
        return sip_positions(
            headers[chip],
            x,
            y,
            unit=unit,
            scale_arcsec=options.scale_arcsec,
            like=like,
            tangent_point=tangent_point,
        )

    def missed(x: Float, y: Float, chip: int, _: float | None) -> Float:
        sip = headers[chip]
        back_x, back_y = sip.inverse(*sip.forward(x, y))
        return np.stack([back_x - x, back_y - y], axis=-1)

    return ReadBack(file, forward, missed)
