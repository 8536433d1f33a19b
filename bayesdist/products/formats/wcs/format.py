"""Files with the keywords of a world coordinate system, of whatever kind, as a format."""

from __future__ import annotations

from bayesdist.products.formats.common.cards import holds_wcs
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import Format

__all__ = ["FORMAT", "describe"]


def _parse(content: Content) -> Content | None:
    return content if any(holds_wcs(hdu.header) for hdu in content.hdus) else None


def describe(content: Content) -> list[str]:
    """Lines of text on each world coordinate system of a file."""
    # astropy.wcs takes longer to import than most files to read
    from bayesdist.products.formats.wcs.text import describe_wcs

    return describe_wcs(content)


FORMAT = Format("wcs", "a FITS file or text file of cards with WCS keywords", 4, _parse, describe)
