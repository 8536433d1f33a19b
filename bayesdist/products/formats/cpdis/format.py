"""Format entry of look-up tables by CPDIS and DP records."""

from __future__ import annotations

from bayesdist.products.formats.common.document import Format
from bayesdist.products.formats.cpdis.build import Settings, build
from bayesdist.products.formats.cpdis.file import CpdisFile, cpdis_calibration, cpdis_of
from bayesdist.products.formats.cpdis.lint import lint_cpdis
from bayesdist.products.formats.sip.format import describe_wcs


def _describe(file: CpdisFile) -> list[str]:
    """Lines of text on the images as astropy.wcs reads them, and on their tables."""
    first, *lines = describe_wcs(file.content, lint_cpdis(file))
    added = []
    for image in file.images:
        for axis in (1, 2):
            plane = image.plane(axis)
            if plane is not None and plane.values.ndim == 2:
                ny, nx = plane.values.shape
                added.append(
                    f"  CPDIS{axis}    {nx} x {ny} nodes, first at pixel ({plane.first[0]:g}, "
                    f"{plane.first[1]:g}), step {plane.step[0]:g} x {plane.step[1]:g}"
                )
        if "BDWORST" in image.header:
            added.append(f"  precision {image.header['BDWORST']:.2g} px")
    return [first, *added, *lines]


FORMAT = Format(
    "cpdis", "an image with CPDIS look-up tables", 33, cpdis_of, _describe, lint_cpdis,
    cpdis_calibration, Settings, build, holds_tables=True,
)  # fmt: skip
