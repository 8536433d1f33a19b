"""Format entry of SIAF tables of coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import Field

from bayesdist.calibration.calibration import Calibration
from bayesdist.errors import InputError
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import (
    PARAMETERS,
    BuildOptions,
    Built,
    Choice,
    Format,
    FormatSettings,
)
from bayesdist.products.formats.common.read_back import ReadBack, of_chips
from bayesdist.products.formats.siaf.lint import lint_siaf
from bayesdist.products.formats.siaf.table import (
    HIGHEST,
    SiafTable,
    holds_table,
    siaf_calibration,
    siaf_read_back,
    table_of,
)
from bayesdist.products.formats.siaf.text import describe_siaf

__all__ = ["FORMAT", "Settings"]

WHERE = "products.siaf"


class Settings(FormatSettings):
    """Configuration of a SIAF table of coefficients."""

    aperture: str | None = None  # by default the names of the chips, or of the detector
    order: Annotated[int, Field(ge=1, le=HIGHEST)] | None = None


def _parse(content: Content) -> SiafTable | None:
    return table_of(content) if holds_table(content) else None


def _calibration(table: SiafTable, _: str, choice: Choice) -> Calibration:
    return siaf_calibration(table, choice)


def _build(
    calibration: Calibration, settings: Settings, options: BuildOptions
) -> tuple[Built, ...]:
    """A table and its side file for each chip."""
    # no file that is read needs it
    from bayesdist.products.formats.siaf.build import siaf_files

    several = len(calibration.numbers) > 1
    out: list[Built] = []
    for chip in calibration.model.chips:
        aperture = (chip.name if several else settings.aperture) or calibration.detector
        if not aperture:
            raise InputError(
                "the aperture has no name", where=WHERE, do="give aperture, as in 'NIS_CEN'"
            )
        made = siaf_files(
            calibration, chip.number, aperture, order=settings.order, options=options, where=WHERE
        )
        # the side file first: whoever reads the table finds it
        out += [
            Built(made.side_name, PARAMETERS, made.side_text.encode("ascii"), made),
            Built(
                made.name, "SIAF table", made.text.encode("ascii"), made.table, chip.number,
                {"closure_pix": made.closure},
            ),
        ]  # fmt: skip
    return tuple(out)


def _read_back(files: Sequence[Built], *_: Any) -> list[ReadBack]:
    """Positions and inverse by the tables alone, as pysiaf has them."""
    parts = {
        one.chip: siaf_read_back(table_of(Content(one.file_name, one.content)))
        for one in files
        if one.chip is not None
    }
    return [of_chips(parts)]


FORMAT = Format(
    "siaf",
    "a SIAF table of coefficients",
    8,
    _parse,
    describe_siaf,
    lint_siaf,
    _calibration,
    Settings,
    _build,
    _read_back,
    highest_order=HIGHEST,
)
