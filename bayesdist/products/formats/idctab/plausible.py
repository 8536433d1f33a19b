"""Sizes, scales and reference values of an IDCTAB that no detector has."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from bayesdist.errors import FormatError
from bayesdist.products.formats.common.document import Finding
from bayesdist.products.formats.idctab.table import IdcTab

# least and most that a column may have, and what it is then
LIMITS = {
    "XSIZE": (1.0, 1e6, "pixels"),
    "YSIZE": (1.0, 1e6, "pixels"),
    "XREF": (-1e6, 1e6, "a pixel"),
    "YREF": (-1e6, 1e6, "a pixel"),
    "V2REF": (-648_000.0, 648_000.0, "arcseconds"),
    "V3REF": (-648_000.0, 648_000.0, "arcseconds"),
    "SCALE": (1e-6, 1e5, "arcseconds in a pixel"),
}


def rows_text(indices: Iterable[int]) -> str:
    """Row numbers from 1, the first few of them by name."""
    numbers = [int(k) + 1 for k in indices]
    shown = ", ".join(map(str, numbers[:3]))
    more = f" and {len(numbers) - 3} more" if len(numbers) > 3 else ""
    return f"row{'s' if len(numbers) > 1 else ''} {shown}{more}"


def _beyond(value: float, name: str) -> str:
    least, most, unit = LIMITS[name]
    return f"{value:g} is not between {least:g} and {most:g} {unit}"


def implausible(tab: IdcTab) -> Iterator[Finding]:
    """Findings on finite values that cannot be meant."""
    if not len(tab.rows):
        yield Finding("error", "rows", "there are none")
    for name, (least, most, _) in LIMITS.items():
        if name in tab.columns:
            values = tab.rows[name].astype(float)
            bad = np.flatnonzero((values < least) | (values > most))
            if name == "SCALE":
                bad = bad[values[bad] != 0]  # which is a finding of its own
            if bad.size:
                where = f"{rows_text(bad)}, column {name}"
                yield Finding("error", where, _beyond(values[bad[0]], name))


def refuse_implausible(tab: IdcTab, rows: Iterable[int]) -> None:
    """Refuse rows of a table that a calibration cannot be made of."""
    for row in rows:
        for name, (least, most, _) in LIMITS.items():
            value = float(tab.rows[name][row]) if name in tab.columns else least
            if not least <= value <= most:
                raise FormatError(
                    _beyond(value, name),
                    where=f"{tab.name}, row {row + 1}, column {name}",
                    do="correct the table, or fetch it again",
                )
