"""Which column of a file is what: as the user says, or by its usual names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping

from bayesdist.errors import InputError

__all__ = ["find_columns"]


def find_columns(
    names: Iterable[str],
    mapping: Mapping[str, str] | None,
    aliases: Mapping[str, tuple[str, ...]],
    *,
    source: str,
    pairs: Iterable[tuple[str, str]] = (),
) -> dict[str, str]:
    """Which column of a file is what.

    Parameters
    ----------
    names : iterable of str
        Columns of the file.
    mapping : mapping of str to str, or None
        Column for each quantity that the user names; an empty name leaves the quantity out.
    aliases : mapping of str to tuple of str
        Usual names, in lower case, for quantities that `mapping` does not name.
    source : str
        File, for the error.
    pairs : iterable of (str, str), optional
        Quantities whose names go together: usual names of which the file has both come first.

    Returns
    -------
    dict of str to str
        Quantities that the file has.

    Raises
    ------
    InputError
        For an unknown quantity, or a column that is not in the file; the nearest name is given.
    """
    names = list(names)
    found: dict[str, str] = {}
    for key, column in (mapping or {}).items():
        if key not in aliases:
            raise InputError(
                f"columns has the key {key!r}, which is no quantity",
                where=source,
                do=f"use {_nearest(key, aliases)}",
            )
        if column and column not in names:
            raise InputError(
                f"column {column!r} is missing", where=source, do=f"name {_nearest(column, names)}"
            )
        found[key] = column
    lower: dict[str, str] = {}
    for name in names:
        # where only case tells two columns apart, the lower-case one is the usual one
        if name.lower() not in lower or name == name.lower():
            lower[name.lower()] = name
    for one, other in pairs:
        if one not in found and other not in found:
            both = zip(aliases[one], aliases[other], strict=True)
            first = next((two for two in both if lower.keys() >= set(two)), None)
            if first is not None:
                found[one], found[other] = lower[first[0]], lower[first[1]]
    for key, usual in aliases.items():
        if key not in found:
            found[key] = next((lower[a] for a in usual if a in lower), "")
    return {key: column for key, column in found.items() if column}


def _nearest(name: str, choices: Iterable[str]) -> str:
    """The nearest choice, or all of them where none is near."""
    choices = list(choices)
    lower = {c.lower(): c for c in choices}
    near = difflib.get_close_matches(name.lower(), lower, n=1, cutoff=0.5)
    if near:
        return f"{lower[near[0]]!r} if that is meant"
    return "one of " + ", ".join(repr(c) for c in choices)
