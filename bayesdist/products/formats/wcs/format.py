"""Files with the keywords of a world coordinate system, of whatever kind, as a format."""

from __future__ import annotations

from collections.abc import Sequence

from bayesdist.products.formats.common.cards import holds_wcs
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import Finding, Format

__all__ = ["FORMAT", "describe"]


def _parse(content: Content) -> Content | None:
    return content if any(holds_wcs(hdu.header) for hdu in content.hdus) else None


def describe(content: Content, extra: Sequence[Finding] = ()) -> list[str]:
    """Lines of text on each world coordinate system of a file, and `extra` findings."""
    # astropy.wcs takes longer to import than most files to read
    from bayesdist.products.formats.wcs.text import describe_wcs

    return describe_wcs(content, extra)


FORMAT = Format("wcs", "a FITS file or text file of cards with WCS keywords", 39, _parse, describe)
