"""Calibration of SIP headers, alone or with their parameter files, and positions from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import fitted_map, refuse_order
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.plane import ARCSEC, Plane, arcsec_per
from bayesdist.data.sky import sky_of_plane, tangent_plane
from bayesdist.formats.sip.files import sip_header, sip_of
from bayesdist.formats.sip.header import SIDE_FILE, SIP_ORDERS, SipHeader
from bayesdist.model import polynomial_terms
from bayesdist.products.common.cards import text_card
from bayesdist.products.common.celestial import refuse_singular, sky_of_header, tangent_form
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import PARAMETERS, BuildOptions, Built, required_size
from bayesdist.products.common.parameters import (
    parameters_content,
    refuse_other,
)
from bayesdist.products.common.read_back import ReadBack
from bayesdist.utils.arrays import Float

NO_LINEAR_ERRORS = (
    "its errors are not stated: AE and BE are those of the non-linear terms alone, and a position "
    "errs by offset, scale and rotation, too; a file of parameters beside the header has them all"
)

NO_SKY = (
    "CTYPE names no position on the sky: u, v are on a plane of unknown position, CD in degrees"
)


def sip_calibration(
    sip: SipHeader,
    name: str,
    *,
    size: tuple[float, float] | None = None,
    pixels: bool = False,
    notes: tuple[str, ...] = (),
) -> Calibration:
    """Calibration of a SIP header: one chip without number, with the header's sigmas if complete.

    Sigmas of the non-linear terms alone are not used, because position errors would be too small.
    `size` is columns and rows, for a header that does not state them (else MissingSizeError). With
    `pixels`, for a file without CD, (u, v) are corrected pixels, otherwise arcseconds. `notes` are
    added to the notes of the calibration.
    """
    image_size = required_size(sip.size, size, name)
    order = max(sip.order) if min(sip.order) >= SIP_ORDERS[0] else 1
    refuse_order(order, name)
    header = sip_header(sip)
    if not pixels:
        refuse_singular(sip.cd, name)
    form = None if pixels or sip.linear_axes else tangent_form(header, name)
    cd = sip.cd if form is None else form.turn @ form.cd
    linear = np.eye(2) if pixels else cd * (1.0 if sip.linear_axes else 3600.0)

    def positions(x: Float, y: Float) -> Float:
        corrected = np.stack(sip.forward(x, y))
        if pixels:
            return corrected
        if sip.linear_axes:
            return cd @ corrected + np.array(sip.crval)[:, None]
        return 3600.0 * (cd @ corrected)

    chip_map = fitted_map(
        positions,
        name,
        order=order,
        size=image_size,
        reference_pixel=sip.crpix,
        unit="pix" if pixels else sip.axes_unit if sip.linear_axes else "arcsec",
        monomial_cov=_variances(sip, linear, order),
    )
    if sip.has_sigmas and not sip.has_linear_sigmas:
        notes = (*notes, NO_LINEAR_ERRORS)
    plane = Plane("detector") if pixels else Plane()
    if form is not None:
        form.check(lambda x, y: positions(x, y) / 3600.0, image_size, header, name)
        plane = Plane("sky", point=form.point)
    elif not pixels and not sip.linear_axes:
        notes = (*notes, NO_SKY)
    return calibration_of_maps(
        {1: chip_map},
        name,
        cov=chip_map.cov,
        errors="sigma",
        plane=plane,
        numbered=False,
        notes=notes,
    )


def _variances(sip: SipHeader, linear: Float, order: int) -> Float | None:
    """Covariance (2 K, 2 K) of the coefficients from the header's sigmas.

    None if the header has no sigmas, or none of the constant and linear terms.
    """
    if not sip.has_linear_sigmas:
        return None
    terms = polynomial_terms(order)
    sigma = [float(s.get(t, 0.0)) for s in (sip.sigma_a, sip.sigma_b) for t in terms]
    turn = np.kron(linear, np.eye(len(terms)))
    return (turn * np.array(sigma) ** 2) @ turn.T


AGREE = 1e-4  # pixels; ten times the accuracy of the reprojection to the plane of CRVAL
_GRID = 33


def with_side_file(sip: SipHeader, name: str) -> SipHeader:
    """Header that names the file with its covariance."""
    return replace(sip, cards=(*sip.cards, text_card(SIDE_FILE, name, "file with the covariance")))


def side_file(calibration: Calibration, chip: int, epoch: float | None, header: str) -> Built:
    """Parameter file of one chip at one date, a companion of the header file `header`."""
    date = epoch if calibration.model.time is not None else None
    dated = calibration.only(chip, date)
    name = f"{Path(header).stem}_parameters.fits"
    return Built(name, PARAMETERS, parameters_content(dated), dated, chip)


def agreeing(stored: Calibration, found: Calibration) -> Calibration:
    """Stored calibration of a header, after checking that the header agrees with it."""
    refuse_other(_difference(found, stored), AGREE, found.name)
    return replace(stored, notes=tuple(n for n in found.notes if n != NO_LINEAR_ERRORS))


def _difference(found: Calibration, stored: Calibration) -> float:
    """Largest distance between positions in pixels: on the sky, or after the best similarity."""
    [found_chip], [stored_chip] = found.numbers, stored.numbers
    if found.model.chips[0].size != stored.model.chips[0].size:
        return float("inf")
    x, y = detector_grid(found.model.chips[0].size, _GRID)
    a = found.forward(x, y, chip=found_chip)
    b = stored.forward(x, y, chip=stored_chip)
    pixel = np.sqrt(abs(np.linalg.det(stored.chip(stored_chip, origin="stated").linear)))
    if found.plane.point is not None and stored.plane.point is not None:
        xi, eta = (ARCSEC[found.unit] * a).T
        ra, dec = sky_of_plane(xi, eta, found.plane.point)
        a = np.stack(tangent_plane(ra, dec, stored.plane.point), axis=-1) / ARCSEC[stored.unit]
        return float(np.hypot(*(a - b).T).max() / pixel)
    w, z = a @ [1, 1j], b @ [1, 1j]
    design = np.stack([np.ones_like(w), w], axis=1)
    residual = design @ np.linalg.lstsq(design, z, rcond=None)[0] - z
    return float(np.abs(residual).max() / pixel)


# -- positions as users of the headers obtain them ------------------------------------------------


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
