"""Format entry of look-up tables by CPDIS and DP records."""

from __future__ import annotations

from pydantic import PositiveFloat

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.orientation import placed_at
from bayesdist.products.formats.common.document import (
    BuildOptions,
    Built,
    Choice,
    Format,
    FormatSettings,
)
from bayesdist.products.formats.cpdis.file import CpdisFile, cpdis_calibration, cpdis_of
from bayesdist.products.formats.cpdis.lint import lint_cpdis
from bayesdist.products.formats.sip.format import describe_wcs


class Settings(FormatSettings):
    """Configuration of a file with look-up tables."""

    step: PositiveFloat | None = None
    crval: tuple[float, float] | None = None


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


def _calibration(file: CpdisFile, name: str, choice: Choice) -> Calibration:
    return cpdis_calibration(file, name, size=choice.size, as_used=choice.as_used)


def _build(
    calibration: Calibration, settings: Settings, options: BuildOptions
) -> tuple[Built, ...]:
    # no file that is read needs it
    from bayesdist.products.formats.cpdis.build import cpdis_content

    calibration = placed_at(
        calibration, settings.crval, options.scale_arcsec, where="products.cpdis"
    )
    content, worst = cpdis_content(
        calibration,
        epoch=options.epoch,
        scale_arcsec=options.scale_arcsec,
        notes=[note for note in (*calibration.notes, calibration.plane.note) if note],
        step=settings.step,
    )
    return (Built("cpdis.fits", "CPDIS", content, calibration, None, {"tables_pix": worst}),)


FORMAT = Format(
    "cpdis", "an image with CPDIS look-up tables", 33, cpdis_of, _describe, lint_cpdis,
    _calibration, Settings, _build, holds_tables=True,
)  # fmt: skip
