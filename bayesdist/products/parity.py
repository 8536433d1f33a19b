"""Sense of V2 and V3 against the axes of an aperture, as stwcs has it (wcsutil/instruments.py).

V2 = V2REF + p0 Xc,  V3 = V3REF + p1 Yc
"""

from __future__ import annotations

from bayesdist.errors import InputError

__all__ = ["parity_of"]

_PARITY = {
    ("ACS", "WFC"): (1, -1),
    ("ACS", "HRC"): (-1, 1),
    ("ACS", "SBC"): (-1, 1),
    ("WFC3", "UVIS"): (-1, 1),
    ("WFC3", "IR"): (-1, 1),
}


def parity_of(instrument: str, detector: str) -> tuple[int, int]:
    """Parities (p0, p1) of a detector.

    Raises
    ------
    InputError
        For a detector that is not known.
    """
    try:
        return _PARITY[instrument.strip().upper(), detector.strip().upper()]
    except KeyError:
        known = ", ".join(f"{i}/{d}" for i, d in _PARITY)
        raise InputError(
            f"the parity of {instrument}/{detector} is not known",
            where="products.idctab",
            do=f"choose one of {known}",
        ) from None
