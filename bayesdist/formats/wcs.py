"""Format of files with WCS keywords that no other format recognizes."""

from __future__ import annotations

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
    """Raise the InputError that names an unsupported projection."""
    for hdu in content.hdus:
        code = projection_code(hdu.header)
        if code and code not in HELD_PROJECTIONS:
            refuse_projection(code, name)


FORMAT = Format(
    "wcs",
    "a FITS file or text file of cards with WCS keywords",
    39,
    _parse,
    describe_wcs,
    refuse=_refuse,
)
