"""Files with the keywords of a world coordinate system, of whatever kind, as a format."""

from __future__ import annotations

from bayesdist.products.formats.common.cards import holds_wcs
from bayesdist.products.formats.common.celestial import (
    HELD_PROJECTIONS,
    projection_code,
    refuse_projection,
)
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import Format
from bayesdist.products.formats.sip.format import describe_wcs


def _parse(content: Content) -> Content | None:
    headers = [hdu.header for hdu in content.hdus]
    return content if any(holds_wcs(one) or projection_code(one) for one in headers) else None


def _refuse(content: Content, name: str) -> None:
    """Name the projection of a header that has another one than TAN."""
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
