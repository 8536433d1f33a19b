"""Properties of HST detectors that IDCTABs lack: parities and filter wheels.

V2 = V2REF + p0 Xc, V3 = V3REF + p1 Yc, with the parities p0, p1 of stwcs (wcsutil/instruments.py).
An IDCTAB of ACS names the filters in both wheels in each row.
"""

from __future__ import annotations

from bayesdist.errors import InputError

_PARITY = {
    ("ACS", "WFC"): (1, -1),
    ("ACS", "HRC"): (-1, 1),
    ("ACS", "SBC"): (-1, 1),
    ("WFC3", "UVIS"): (-1, 1),
    ("WFC3", "IR"): (-1, 1),
}

# FILTER1 and FILTER2 in actual IDCTABs; ramp filters (FR...) are all in the second wheel.
_FIRST = (
    "F475W", "F502N", "F550M", "F555W", "F606W", "F625W", "F658N", "F775W", "F850LP", "F892N",
    "G800L", "POL0UV", "POL60UV", "POL120UV",
)  # fmt: skip
_SECOND = ("F435W", "F660N", "F814W", "POL0V", "POL60V", "POL120V")


def parity_of(instrument: str, detector: str) -> tuple[int, int]:
    """Parities (p0, p1) of a detector; InputError if the detector is unknown."""
    try:
        return _PARITY[instrument.strip().upper(), detector.strip().upper()]
    except KeyError:
        detectors = ", ".join(f"{i}/{d}" for i, d in _PARITY)
        raise InputError(
            f"the parity of {instrument}/{detector} is not known",
            where="products.idctab",
            do=f"choose one of {detectors}",
        ) from None


def combination_of(filter: str | tuple[str, ...], instrument: str) -> tuple[str, ...]:
    """Filter names in all wheels, such as ("F606W", "CLEAR2L") for ACS, with unused wheels clear.

    A single name for other instruments; a tuple is returned unchanged. InputError for an ACS filter
    that is in neither wheel.
    """
    if not isinstance(filter, str):
        return tuple(map(str, filter))
    name = filter.strip().upper()
    if instrument != "ACS":
        return (name,)
    if name.startswith("CLEAR"):
        return ("CLEAR1L", "CLEAR2L")
    if name in _FIRST:
        return (name, "CLEAR2L")
    if name in _SECOND or name.startswith("FR"):
        return ("CLEAR1L", name)
    raise InputError(
        f"the filter wheel of {filter!r} is not known",
        where="filters",
        do='name both wheels, as ("F606W", "CLEAR2L")',
    )


def serves(row: tuple[str, ...], asked: tuple[str, ...]) -> bool:
    """True if a row of an IDCTAB with these filters is valid for the requested ones, as in stwcs.

    All CLEAR positions are equivalent; a row without filters is valid for all.
    """
    if not row:
        return True
    row, asked = (
        tuple("CLEAR" if "CLEAR" in name.upper() else name.strip() for name in names)
        for names in (row, asked)
    )
    if len(asked) == len(row):
        return asked == row
    remaining = [name for name in row if name not in asked]
    return set(asked) - {"CLEAR"} <= set(row) and all(
        name in ("CLEAR", "N/A") for name in remaining
    )
