"""Format entry of the SIP header."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field

from bayesdist.calibration.calibration import Calibration
from bayesdist.products.formats.common.cards import header_of
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import (
    BuildOptions,
    Built,
    Choice,
    Finding,
    Format,
    FormatSettings,
)
from bayesdist.products.formats.common.read_back import ReadBack
from bayesdist.products.formats.sip.calibration import sip_calibration
from bayesdist.products.formats.sip.lint import lint_sip
from bayesdist.products.formats.sip.read import holds_sip, sip_of
from bayesdist.products.formats.sip.write import sip_text
from bayesdist.products.formats.wcs.format import describe as describe_wcs

__all__ = ["FORMAT", "Settings"]


class Settings(FormatSettings):
    """Configuration of a SIP header."""

    inverse_order: Annotated[int, Field(ge=2, le=9)] | None = None
    linear: Literal["cd", "sip"] = "cd"
    crval: tuple[float, float] | None = None


def _parse(content: Content) -> Content | None:
    return content if holds_sip(content) else None


def _lint(content: Content) -> tuple[Finding, ...]:
    return lint_sip(sip_of(content))


def _calibration(content: Content, name: str, choice: Choice) -> Calibration:
    sip = sip_of(content)
    stated = [k for k in ("D2IMDIS1", "D2IMDIS2", "CPDIS1", "CPDIS2") if k in header_of(sip.cards)]
    notes = (f"without the look-up tables of {', '.join(stated)}",) if stated else ()
    return sip_calibration(sip, name, size=choice.size, notes=notes)


def _read_back(
    files: Sequence[Built], calibration: Calibration, options: BuildOptions
) -> list[ReadBack]:
    # no file that is read needs it
    from bayesdist.products.formats.sip.positions import sip_read_back

    return sip_read_back(files, calibration, options)


def _build(
    calibration: Calibration, settings: Settings, options: BuildOptions
) -> tuple[Built, ...]:
    """Headers, one for each chip."""
    # no file that is read needs it
    from bayesdist.products.formats.sip.build import sip_from_solution

    notes = [*calibration.notes, *([calibration.plane.note] if calibration.plane.note else [])]
    out = []
    for number in calibration.numbers:
        sip = sip_from_solution(
            calibration,
            chip=number,
            epoch=options.epoch,
            scale_arcsec=options.scale_arcsec,
            notes=notes,
            **settings.model_dump(),
        )
        name = f"sip_{number}.hdr" if len(calibration.numbers) > 1 else "sip.hdr"
        summary = {"closure_pix": sip.closure, "a_dmax": sip.a_dmax, "b_dmax": sip.b_dmax}
        out.append(Built(name, "SIP", sip_text(sip).encode("ascii"), sip, number, summary))
    return tuple(out)


FORMAT = Format(
    "sip",
    "a SIP header",
    1,
    _parse,
    describe_wcs,
    _lint,
    _calibration,
    Settings,
    _build,
    _read_back,
)
