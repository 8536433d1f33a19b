"""Format entry of the IDCTAB."""

from __future__ import annotations

from pydantic import PositiveFloat

from bayesdist.calibration.calibration import Calibration
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import (
    BuildOptions,
    Built,
    Choice,
    Format,
    FormatSettings,
)
from bayesdist.products.formats.idctab.build import idctab_from_solution
from bayesdist.products.formats.idctab.calibration import idctab_calibration
from bayesdist.products.formats.idctab.lint import lint_idctab
from bayesdist.products.formats.idctab.table import HIGHEST, IdcTab
from bayesdist.products.formats.idctab.text import describe_idctab

__all__ = ["FORMAT", "Settings"]


class Settings(FormatSettings):
    """Configuration of an IDCTAB reference file."""

    instrument: str
    detector: str
    v2ref: float = 0.0
    v3ref: float = 0.0
    vafactor: PositiveFloat = 1.0
    filters: list[str] | list[list[str]] | None = None
    useafter: str | None = None
    pedigree: str | None = None


def _parse(content: Content) -> IdcTab | None:
    hdus = content.tables
    if len(hdus) < 2:
        return None
    columns = {str(value).strip() for value in hdus[1].header.values()}
    if not {"XREF", "YREF"} <= columns or not {"CX10", "A10"} & columns:
        return None
    return IdcTab(hdus, content.name)


def _calibration(tab: IdcTab, _: str, choice: Choice) -> Calibration:
    return idctab_calibration(tab, choice.filter)


def _build(
    calibration: Calibration, settings: Settings, options: BuildOptions
) -> tuple[Built, ...]:
    tab = idctab_from_solution(
        calibration,
        scale_arcsec=options.scale_arcsec,
        history=calibration.notes,
        **settings.model_dump(exclude_none=True),
    )
    name = f"{settings.instrument}_{settings.detector}_idc.fits".lower()
    return (Built(name, "IDCTAB", b"".join(hdu.to_bytes() for hdu in tab.hdus), tab),)


FORMAT = Format(
    "idctab",
    "an IDCTAB",
    2,
    _parse,
    describe_idctab,
    lint_idctab,
    _calibration,
    Settings,
    _build,
    highest_order=HIGHEST,
)
