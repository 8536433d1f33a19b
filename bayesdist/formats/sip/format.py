"""Format of SIP headers: description as text, and calibration, alone or with a parameter file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from astropy.io import fits
from pydantic import Field

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import fitted_map, refuse_order
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.orientation import MAX_DEPARTURE, departure_from_tangent_plane
from bayesdist.calibration.plane import ARCSEC, Plane, arcsec_per
from bayesdist.data.tangent import sky_of_plane, tangent_plane
from bayesdist.formats.sip.build import sip_from_solution, sip_wcs
from bayesdist.formats.sip.files import holds_sip, parsed, sip_header, sip_of, sip_text
from bayesdist.formats.sip.header import (
    SIDE_FILE,
    SIP_ORDERS,
    SipHeader,
    forward_is_used,
    inverse_is_used,
    worst_closure,
)
from bayesdist.formats.sip.lint import lint_sip
from bayesdist.model import polynomial_terms
from bayesdist.plugin import mission_objects
from bayesdist.products.common.cards import header_of, text_card
from bayesdist.products.common.celestial import refuse_singular, sky_of_header, tangent_form
from bayesdist.products.common.coefficients import sip_keyword
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import (
    PARAMETERS,
    BuildOptions,
    Built,
    Choice,
    DistortionText,
    Finding,
    Format,
    FormatSettings,
    ReadBack,
    required_size,
)
from bayesdist.products.common.parameters import (
    parameters_content,
    refuse_other,
    with_parameters,
)
from bayesdist.products.common.wcs_text import describe_wcs
from bayesdist.utils.arrays import Float


class SipSettings(FormatSettings):
    """Configuration of a SIP header."""

    inverse_order: Annotated[int, Field(ge=2, le=9)] | None = None
    linear: Literal["cd", "sip"] = "cd"
    # None: sky, except for wide fields without a sky position
    axes: Literal["sky", "linear"] | None = None
    crval: tuple[float, float] | None = None
    parameters: bool = True  # True to write a companion file with the covariance


def _parse(content: Content) -> Content | None:
    return content if holds_sip(content) else None


def _lint(content: Content) -> tuple[Finding, ...]:
    return lint_sip(sip_of(content), explain=_explain)


def _explain(sip: SipHeader, size: tuple[int, int], closure: float) -> Iterable[Finding]:
    """Findings of the check that a mission provides for `lint_sip`; none without such a mission."""
    check = mission_objects(lambda mission: mission.checks, only="sip").get("sip")
    return () if check is None else check(sip, size, closure)


def _calibration(content: Content, name: str, choice: Choice) -> Calibration:
    sip = sip_of(content)
    stated = [k for k in ("D2IMDIS1", "D2IMDIS2", "CPDIS1", "CPDIS2") if k in header_of(sip.cards)]
    notes = (f"without the look-up tables of {', '.join(stated)}",) if stated else ()
    calibration = sip_calibration(sip, name, size=choice.size, notes=notes)
    if choice.as_used:
        return calibration
    named = str(header_of(sip.cards).get(SIDE_FILE, ""))
    return with_parameters(calibration, content.beside(named), named, agreeing)


def _build(
    calibration: Calibration, settings: SipSettings, options: BuildOptions
) -> tuple[Built, ...]:
    """Build one header per chip."""
    out = []
    departure = _projection_matters(calibration, settings, options)
    axes = settings.axes or ("linear" if departure else "sky")
    for number in calibration.numbers:
        sip = sip_from_solution(
            calibration,
            chip=number,
            epoch=options.epoch,
            scale_arcsec=options.scale_arcsec,
            notes=calibration.remarks,
            axes=axes,
            **settings.model_dump(exclude={"parameters", "axes"}),
        )
        several = len(calibration.numbers) > 1
        name = options.named(f"sip_{number}.hdr" if several else "sip.hdr", several=several)
        if settings.parameters:
            parameter_file = side_file(calibration, number, options.epoch, name)
            sip = with_side_file(sip, parameter_file.file_name)
            out.append(parameter_file)
        summary = {"closure_pix": sip.closure, "a_dmax": sip.a_dmax, "b_dmax": sip.b_dmax}
        text = sip_text(sip).encode("ascii")
        warnings = (*departure, *_warnings(sip, calibration))
        notes = _notes(sip, calibration)
        out.append(Built(name, "SIP", text, sip, number, summary, warnings, notes))
    return tuple(out)


def _notes(sip: SipHeader, calibration: Calibration) -> tuple[str, ...]:
    """Notes on consequences of the product's settings.

    A note is given if CRVAL is a placeholder because the sky position is neither known nor given,
    and if A and B hold terms below order 2 as requested.
    """
    out = []
    if _sky_is_assumed(sip, calibration) and sip.crval == (0.0, 0.0):
        remedy = f"set products.sip.crval{_or_linear(calibration)}"
        out.append(f"CRVAL is a placeholder, and {_axes(sip)}: {remedy}")
    low = {k: c for terms in (sip.a, sip.b) for k, c in terms.items() if sum(k) < 2 and c}
    if low:
        out.append(
            "A and B hold constant or linear terms, which astropy applies and stwcs and gwcs drop: "
            "set products.sip.linear = 'cd' for those"
            if any(sum(k) == 1 for k in low)
            else "A_0_0 and B_0_0 hold what CRVAL leaves, which astropy applies and stwcs and gwcs "
            "drop"
        )
    return tuple(out)


def _projection_matters(
    calibration: Calibration, settings: SipSettings, options: BuildOptions
) -> tuple[str, ...]:
    """Warning that angular u, v may be in a projection other than TAN; empty if this is negligible.

    See `departure_from_tangent_plane`.
    """
    stated = settings.axes is not None or settings.crval is not None
    if calibration.unit == "pix" or stated or calibration.plane.point is not None:
        return ()
    if calibration.model.time is not None and options.epoch is None:
        return ()  # the function that builds the header reports the missing epoch
    worst = departure_from_tangent_plane(calibration, options.epoch, None)
    if worst <= MAX_DEPARTURE:
        return ()
    return (
        "the axes are linear: where u, v lie on the sky is not stated, and whether they are a "
        f"tangent plane is worth {worst:.2g} px in so wide a field. If they are one, set "
        "products.sip.crval or axes = 'sky'",
    )


def _warnings(sip: SipHeader, calibration: Calibration) -> tuple[str, ...]:
    """Warning if the header has sky axes that the solution does not state."""
    if not _sky_is_assumed(sip, calibration) or sip.crval == (0.0, 0.0):
        return ()
    return (f"{_axes(sip)}: check that they are{_or_linear(calibration)}",)


def _sky_is_assumed(sip: SipHeader, calibration: Calibration) -> bool:
    """True if the header has sky axes although the solution has no sky position."""
    return not sip.linear_axes and calibration.plane.point is None


def _axes(sip: SipHeader) -> str:
    """Clause that states the sky directions which the header assumes for u and v."""
    mirrored = ", which makes the image a mirror of the sky" if np.linalg.det(sip.cd) > 0 else ""
    return f"u is taken for east and v for north{mirrored}"


def _or_linear(calibration: Calibration) -> str:
    """Alternative remedy, for u and v in pixels."""
    return ", or set axes = 'linear'" if calibration.unit == "pix" else ""


# -- description ----------------------------------------------------------------------------------


# keywords that drizzling adds to its output image
_DRIZZLED = ("NDRIZIM", "D001DATA", "D001SCAL", "D001PIXF")


def describe_sip(content: Content, extra: Sequence[Finding] = ()) -> list[str]:
    """Lines of text on each world coordinate system of a file, and `extra` findings."""

    def distortion(header: fits.Header, name: str) -> DistortionText | None:
        if "A_ORDER" not in header:
            return None
        sip = parsed(header, name)
        findings = [*lint_sip(sip, explain=_explain), *_left_over(header)]
        return DistortionText(sip_lines(sip, name), coefficient_lines(sip), findings)

    return describe_wcs(content, extra, distortion)


def sip_lines(sip: SipHeader, name: str) -> list[str]:
    """Lines of text on a header, without its coefficients."""
    size = "unknown" if sip.size is None else f"{sip.size[0]} x {sip.size[1]} px"
    scale = np.sqrt(abs(np.linalg.det(sip.cd)))
    unit = place = {"pix": "px"}.get(sip.axes_unit, sip.axes_unit)
    if not sip.linear_axes:
        scale, unit, place = 3600 * scale, "arcsec", "deg"
    lines = [
        f"{name}: SIP header, A_ORDER {sip.order[0]}, B_ORDER {sip.order[1]}, image size {size}",
        f"  CTYPE     {sip.ctype[0]}, {sip.ctype[1]}",
        f"  CRPIX     {sip.crpix[0]:.10g}, {sip.crpix[1]:.10g}",
        f"  CRVAL     {sip.crval[0]:.10g}, {sip.crval[1]:.10g} {place}",
        f"  scale     {scale:.8g} {unit}/px",
        f"  CD        {' '.join(f'{value:.10g}' for value in sip.cd.flat)}",
    ]
    if sip.offset is not None:
        lines.append(f"  offset    {sip.offset[0]:.10g}, {sip.offset[1]:.10g} {sip.unit} at CRVAL")
    for prefix, value in zip("AB", sip.dmax, strict=True):
        if value is not None:
            lines.append(f"  {prefix}_DMAX    {value:.6g} px")
    if sip.inverse_order is not None:
        lines.append(f"  inverse   AP_ORDER {sip.inverse_order[0]}, worst closure {_closure(sip)}")
    return lines


def _closure(sip: SipHeader) -> str:
    """Clause on the stated and the computed closure of AP and BP."""
    stated = "not stated" if sip.closure is None else f"stated {sip.closure:.3g} px"
    if sip.size is None:
        return f"{stated}; not computed, for the image size is not known"
    if not (forward_is_used(sip) and inverse_is_used(sip)):
        return f"{stated}; not computed, for programs ignore orders below {SIP_ORDERS[0]}"
    return f"{stated}, computed {worst_closure(sip, sip.size):.3g} px"


def coefficient_lines(sip: SipHeader) -> list[str]:
    """Lines with all coefficients; an empty line precedes each family."""
    lines = []
    for prefix, terms, sigma in (
        ("A", sip.a, sip.sigma_a), ("B", sip.b, sip.sigma_b), ("AP", sip.ap, {}), ("BP", sip.bp, {})
    ):  # fmt: skip
        if terms:
            lines += ["", *_term_lines(prefix, terms, sigma)]
    return lines


def _term_lines(
    prefix: str,
    terms: Mapping[tuple[int, int], float],
    sigma: Mapping[tuple[int, int], float],
) -> list[str]:
    out = []
    for powers in sorted(terms, key=lambda t: (sum(t), -t[0])):
        error = f"  +- {sigma[powers]:.3e}" if powers in sigma else ""
        out.append(f"  {sip_keyword(prefix, *powers):<7} {terms[powers]:21.13e}{error}")
    return out


def _left_over(header: fits.Header) -> Iterator[Finding]:
    """Finding on SIP coefficients in the header of a drizzled image, which has no distortion."""
    drizzled = [key for key in _DRIZZLED if key in header]
    if drizzled:
        yield Finding(
            "warning",
            "A_ORDER, B_ORDER",
            f"SIP coefficients beside {drizzled[0]}: the image was drizzled, which removes the "
            "distortion, and the coefficients of an input image may be left over: they are "
            "applied here; delete them if so",
        )


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


FORMAT = Format(
    "sip",
    "a SIP header",
    1,
    _parse,
    describe_sip,
    _lint,
    _calibration,
    SipSettings,
    _build,
    sip_read_back,
    highest_order=SIP_ORDERS[1],
    needs_scale=lambda settings: settings.axes != "linear",
    asks=("size",),
    fits_wcs=sip_wcs,
)
