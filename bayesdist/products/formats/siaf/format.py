"""Format entry of SIAF tables of coefficients, and their description as text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import Built, Format, finding_lines
from bayesdist.products.formats.common.read_back import ReadBack, of_chips
from bayesdist.products.formats.common.record import calibration_from, error_lines
from bayesdist.products.formats.siaf.build import Settings, build
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
    record = table.record
    found = None if record is None else lambda: calibration_from(record, table.name)
    return error_lines(found, "a side file")


def _parse(content: Content) -> SiafTable | None:
    return table_of(content) if holds_table(content) else None


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
    siaf_calibration,
    Settings,
    build,
    _read_back,
    highest_order=HIGHEST,
)
