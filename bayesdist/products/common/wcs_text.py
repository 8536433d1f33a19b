"""Text on the world coordinate systems of a file, for `describe` of formats with FITS headers."""

from __future__ import annotations

from collections.abc import Sequence

from bayesdist.products.common.content import Content
from bayesdist.products.common.document import DistortionReader, Finding


def describe_wcs(
    file: Content, extra: Sequence[Finding] = (), distortion: DistortionReader | None = None
) -> list[str]:
    """Lines of text on every world coordinate system of a file, with its findings.

    `extra` findings on the file are listed with those of its first system. HDUs that repeat the
    system of an earlier HDU are listed with that one. `distortion` describes the coefficients of a
    format and may raise FormatError.
    """
    # importing astropy.wcs takes longer than reading most files
    from bayesdist.products.common.wcs_systems import describe_systems

    return describe_systems(file, extra, distortion)
