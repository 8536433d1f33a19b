"""Format of files with WCS keywords that no other format recognizes."""

from __future__ import annotations

from bayesdist.errors import InputError
from bayesdist.products.common.cards import holds_wcs
from bayesdist.products.common.celestial import (
    HELD_PROJECTIONS,
    projection_code,
    refuse_projection,
)
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import Format
from bayesdist.products.common.wcs_text import describe_wcs


def _parse(content: Content) -> Content | None:
    headers = [hdu.header for hdu in content.hdus]
    return (
        content if any(holds_wcs(header) or projection_code(header) for header in headers) else None
    )


def _refuse(content: Content, name: str) -> None:
    """Raise the InputError that names an unsupported projection, or a WCS without distortion."""
    codes = [projection_code(hdu.header) for hdu in content.hdus]
    for code in codes:
        if code and code not in HELD_PROJECTIONS:
            refuse_projection(code, name)
    if any(codes):
        raise InputError(
            "is a WCS without distortion",
            where=name,
            do="sample it through astropy.wcs: `bayesdist convert FILE --sample --to sip` writes a "
            "header of another form with the same positions",
        )


FORMAT = Format(
    "wcs",
    "a FITS file or text file of cards with WCS keywords",
    39,
    _parse,
    describe_wcs,
    refuse=_refuse,
)
