"""Names that a user chose, checked against those that exist."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches

from bayesdist.errors import InputError

__all__ = ["require_known"]


def require_known(name: str, known: Sequence[str], what: str, *, where: str = "") -> None:
    """Pass a known name.

    Parameters
    ----------
    name : str
    known : sequence of str
    what : str
        What the name stands for, as in ``"statistic"``.
    where : str, optional
        Where it was given.

    Raises
    ------
    InputError
        For an unknown name; it names the nearest known one, or all of them where none is near.
    """
    if name in known:
        return
    near = get_close_matches(str(name).lower(), known, n=1, cutoff=0.5)
    do = f"use {near[0]!r} if that is meant" if near else f"choose one of {', '.join(known)}"
    raise InputError(f"unknown {what} {name!r}", where=where, do=do)
