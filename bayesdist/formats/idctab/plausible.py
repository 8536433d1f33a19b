"""Plausible ranges of sizes, scales and reference values of an IDCTAB."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from bayesdist.errors import FormatError
from bayesdist.formats.idctab.table import IdcTab
from bayesdist.products.common.document import Finding

# smallest and largest plausible value of a column, and its unit
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
    """Row numbers counted from 1: the first three, and the number of further ones."""
    numbers = [int(k) + 1 for k in indices]
    shown = ", ".join(map(str, numbers[:3]))
    further = f" and {len(numbers) - 3} more" if len(numbers) > 3 else ""
    return f"row{'s' if len(numbers) > 1 else ''} {shown}{further}"


def _beyond(value: float, name: str) -> str:
    lowest, highest, unit = LIMITS[name]
    return f"{value:g} is not between {lowest:g} and {highest:g} {unit}"


def implausible(tab: IdcTab) -> Iterator[Finding]:
    """Findings on finite values that are implausible."""
    if not len(tab.rows):
        yield Finding("error", "rows", "there are none")
    for name, (lowest, highest, _) in LIMITS.items():
        if name in tab.columns:
            values = tab.rows[name].astype(float)
            bad = np.flatnonzero((values < lowest) | (values > highest))
            if name == "SCALE":
                bad = bad[values[bad] != 0]  # `lint` reports a zero SCALE
            if bad.size:
                location = f"{rows_text(bad)}, column {name}"
                yield Finding("error", location, _beyond(values[bad[0]], name))


def refuse_implausible(tab: IdcTab, rows: Iterable[int]) -> None:
    """Raise FormatError if rows that a calibration needs have implausible values."""
    for row in rows:
        for name, (lowest, highest, _) in LIMITS.items():
            value = float(tab.rows[name][row]) if name in tab.columns else lowest
            if not lowest <= value <= highest:
                raise FormatError(
                    _beyond(value, name),
                    where=f"{tab.name}, row {row + 1}, column {name}",
                    do="correct the table, or fetch it again",
                )
