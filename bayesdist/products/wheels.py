"""Which filter wheel of ACS/WFC a filter stands in: an IDCTAB names both wheels in each row."""

from __future__ import annotations

from bayesdist.errors import InputError

__all__ = ["combination_of"]

# FILTER1 and FILTER2 of real IDCTABs; ramp filters (FR...) are all in the second wheel.
_FIRST = (
    "F475W", "F502N", "F550M", "F555W", "F606W", "F625W", "F658N", "F775W", "F850LP", "F892N",
    "G800L", "POL0UV", "POL60UV", "POL120UV",
)  # fmt: skip
_SECOND = ("F435W", "F660N", "F814W", "POL0V", "POL60V", "POL120V")


def combination_of(filter: str | tuple[str, ...], instrument: str) -> tuple[str, ...]:
    """Names of all wheels for a filter, the others being clear.

    Parameters
    ----------
    filter : str or tuple of str
        One name, as "F606W" or "CLEAR"; a tuple is given back as it is.
    instrument : str
        INSTRUME.

    Returns
    -------
    tuple of str
        As ("F606W", "CLEAR2L") for ACS; one name for others.

    Raises
    ------
    InputError
        When the wheel of an ACS filter is not known.
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
