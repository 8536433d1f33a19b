"""Rows that lack a value: left out and counted by reason, or refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import InputError

__all__ = ["NOT_FINITE", "absent", "check_not_finite", "counted", "without_missing"]

Bool = NDArray[np.bool_]

NOT_FINITE = ("refuse", "reject")


def check_not_finite(value: str) -> None:
    """Refuse what the option `not_finite` cannot be."""
    if value not in NOT_FINITE:
        raise InputError(
            f"not_finite is {value!r}",
            where="data.not_finite",
            do="set it to 'refuse' or 'reject'",
        )


def absent(column: Any, *, not_finite: bool) -> Bool:
    """Boolean mask of the rows of a column that have no value.

    Parameters
    ----------
    column : astropy Column, Quantity, Time or array, shape (N,)
    not_finite : bool
        Count NaN and infinity as no value, too.

    Returns
    -------
    ndarray of bool, shape (N,)
    """
    mask = np.array(np.broadcast_to(getattr(column, "mask", False), np.shape(column)), bool)
    if mask.ndim > 1:  # a column of arrays, which is refused elsewhere
        return np.zeros(len(mask), bool)
    if not_finite:
        plain = getattr(column, "unmasked", column)
        values = np.asarray(getattr(plain, "value", plain))
        if values.dtype.kind == "f":
            mask |= ~np.isfinite(values)
    return mask


def counted(reasons: Sequence[tuple[str, Bool]], n: int) -> tuple[Bool, dict[str, int]]:
    """Boolean mask of the rows that stay, and how many others go for the first of their reasons.

    Parameters
    ----------
    reasons : sequence of (str, ndarray of bool)
        Rows that go for each.
    n : int
        Rows.
    """
    stay, counts = np.ones(n, bool), dict[str, int]()
    for reason, gone in reasons:
        new = int((stay & gone).sum())
        if new:
            counts[reason] = counts.get(reason, 0) + new
            stay &= ~gone
    return stay, counts


def without_missing(
    table: Any,
    found: Mapping[str, str],
    *,
    source: str,
    reject: bool,
    spared: frozenset[str],
    motions: frozenset[str],
) -> tuple[Bool, dict[str, int]]:
    """Boolean mask of the rows that have a value in every column that is read.

    Parameters
    ----------
    table : astropy Table
    found : mapping of str to str
        Column of each quantity.
    source : str
    reject : bool
        Leave rows out whose value is not finite, too.
    spared : frozenset of str
        Quantities whose missing values do no harm.
    motions : frozenset of str
        Quantities of which NaN means that a star has none, as catalogues write it.

    Returns
    -------
    stay : ndarray of bool, shape (N,)
    counts : dict of str to int
        Rows left out, by reason.

    Raises
    ------
    InputError
        When no row is left.
    """
    reasons = []
    for key, name in found.items():
        if key in spared:
            continue
        reason = "no proper motion" if key in motions else f"no value in column {name!r}"
        gone = absent(table[name], not_finite=reject or key in motions)
        reasons.append((reason, gone))
    stay, counts = counted(reasons, len(table))
    if not stay.any():
        text = ", ".join(f"{reason} ({n} rows)" for reason, n in counts.items())
        raise InputError(
            f"no row has a value in every column that is read: {text}",
            where=source,
            do="leave such a column out by an empty name in the option 'columns'",
        )
    return stay, counts
