"""Which coefficient multiplies which powers of x and y: the only place that knows.

=========  =======================  =====================================
format     coefficient              multiplies
=========  =======================  =====================================
bayesdist  term (i, j)              x^i y^j
SIP        A_p_q, B_p_q, AP_, BP_   x^p y^q
IDCTAB     CXnj, CYnj               x^j y^(n-j): CX11 goes with x, CX10 with y
SIAF       Sci2IdlXnj, Sci2IdlYnj   x^(n-j) y^j: the mirror image of IDCTAB
=========  =======================  =====================================

x and y are pixel offsets from the reference pixel.  IDCTAB is as stwcs reads it, SIP as in Shupe et
al. 2005 (ASP Conf. 347, 491).
"""

from __future__ import annotations

import re

__all__ = ["idctab_column", "idctab_powers", "sip_keyword", "sip_powers"]

_IDCTAB = re.compile(r"(CX|CY|A|B)(\d)(\d)")
_SIP = re.compile(r"(A|B|AP|BP|AE|BE)_(\d)_(\d)")


def idctab_column(prefix: str, i: int, j: int) -> str:
    """Column of an IDCTAB that multiplies x^i y^j: ``idctab_column("CX", 1, 0) == "CX11"``."""
    return f"{prefix}{i + j}{i}"


def idctab_powers(column: str) -> tuple[str, int, int] | None:
    """Prefix and powers (i, j) of x and y of an IDCTAB column; None for any other column."""
    match = _IDCTAB.fullmatch(column)
    if match is None or match[3] > match[2]:
        return None
    order, i = int(match[2]), int(match[3])
    return match[1], i, order - i


def sip_keyword(prefix: str, i: int, j: int) -> str:
    """Keyword that multiplies x^i y^j, as ``sip_keyword("A", 2, 0) == "A_2_0"``."""
    return f"{prefix}_{i}_{j}"


def sip_powers(keyword: str) -> tuple[str, int, int] | None:
    """Prefix and powers (i, j) of a SIP keyword or of its sigma; None for any other keyword."""
    match = _SIP.fullmatch(keyword)
    return None if match is None else (match[1], int(match[2]), int(match[3]))
