"""Names of the coefficients of an IDCTAB, in the convention of stwcs.

CXnj and CYnj multiply x^j y^(n-j), where x and y are pixel offsets from the reference pixel: CX11
multiplies x, CX10 y.
"""

from __future__ import annotations

import re

_COLUMN = re.compile(r"(CX|CY|A|B)(\d)(\d)")


def idctab_column(prefix: str, i: int, j: int) -> str:
    """Column of an IDCTAB that multiplies x^i y^j: ``idctab_column("CX", 1, 0) == "CX11"``."""
    return f"{prefix}{i + j}{i}"


def idctab_powers(column: str) -> tuple[str, int, int] | None:
    """Prefix and powers (i, j) of x and y of an IDCTAB column; None for any other column."""
    match = _COLUMN.fullmatch(column)
    if match is None or match[3] > match[2]:
        return None
    order, i = int(match[2]), int(match[3])
    return match[1], i, order - i
