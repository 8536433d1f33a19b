"""Description of a SIP header as text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from astropy.io import fits

from bayesdist.formats.sip.families import forward_is_used, inverse_is_used
from bayesdist.formats.sip.header import SIP_ORDERS, SipHeader, worst_closure
from bayesdist.formats.sip.lint import lint_sip
from bayesdist.formats.sip.read import parsed
from bayesdist.products.common.coefficients import sip_keyword
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import DistortionText, Finding
from bayesdist.products.common.wcs_text import describe_wcs

# keywords that drizzling adds to its output image
_DRIZZLED = ("NDRIZIM", "D001DATA", "D001SCAL", "D001PIXF")


def describe_sip(content: Content, extra: Sequence[Finding] = ()) -> list[str]:
    """Lines of text on each world coordinate system of a file, and `extra` findings."""

    def distortion(header: fits.Header, name: str) -> DistortionText | None:
        if "A_ORDER" not in header:
            return None
        sip = parsed(header, name)
        findings = [*lint_sip(sip), *_left_over(header)]
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
