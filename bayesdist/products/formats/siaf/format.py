"""Format entry of SIAF tables of coefficients, and their description as text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.inverse import detector_grid
from bayesdist.errors import BayesdistError, InputError
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import (
    PARAMETERS,
    BuildOptions,
    Built,
    Choice,
    Format,
    FormatSettings,
    finding_lines,
)
from bayesdist.products.formats.common.read_back import ReadBack, of_chips
from bayesdist.products.formats.common.record import calibration_from
from bayesdist.products.formats.siaf.lint import lint_siaf
from bayesdist.products.formats.siaf.table import (
    HIGHEST,
    NAMES,
    SiafTable,
    holds_table,
    siaf_calibration,
    siaf_read_back,
    table_of,
)


def describe_siaf(table: SiafTable) -> list[str]:
    """Lines of text on a table or a side file, its findings at the end."""
    if not table.rows:
        lines = [f"{table.name}: covariance of the SIAF table of {table.aperture}"]
        return [*lines, *_uncertainty(table), "", *finding_lines(lint_siaf(table))]
    size = table.size
    extent = "unknown" if size is None else f"{size[0]:g} x {size[1]:g} px"
    lines = [
        f"{table.name}: SIAF table of {table.aperture}, order {table.order}",
        f"  detector  {extent}",
    ]
    if size is not None:
        x, y = table.reference_pixel(size)
        source = "" if "XSciRef" in table.stated else ", assumed: the middle"
        lines.append(f"  zero      pixel ({x:g}, {y:g}){source}")
    linear = np.array(
        [[table.terms(name).get(k, 0.0) for k in ((1, 0), (0, 1))] for name in NAMES[:2]]
    )
    lines.append(f"  pixel     {np.sqrt(abs(np.linalg.det(linear))):.8f} arcsec")
    closure = table.closure()
    if closure is not None:
        lines.append(f"  inverse   {closure:.2g} px at worst")
    lines += [*_uncertainty(table), "", f"  nj {' '.join(name.rjust(15) for name in NAMES)}"]
    for row in table.rows:
        lines.append(f"  {row.index} {' '.join(f'{value:15.7g}' for value in row.values)}")
    return [*lines, "", *finding_lines(lint_siaf(table))]


def _uncertainty(table: SiafTable) -> list[str]:
    if table.record is None:
        return ["  errors    none stated"]
    try:
        found = calibration_from(table.record, table.name)
    except BayesdistError:
        return ["  errors    of a side file that cannot be read"]
    [chip] = found.by_chip().values()
    cov = chip.covariance_at(*detector_grid(chip.basis.size, 65))
    if cov is None:
        return ["  errors    none stated"]
    sigma = 1e3 * np.sqrt((cov[:, 0, 0] + cov[:, 1, 1]) / 2)
    return [
        f"  errors    {found.errors}: {np.median(sigma):.3g} mas per axis at the median, "
        f"{sigma.max():.3g} at worst"
    ]


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
                "the aperture has no name",
                where=WHERE,
                do="give aperture, as in 'NIS_CEN' (of convert: --option aperture=NIS_CEN)",
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
