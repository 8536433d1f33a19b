"""Rows that stand twice in a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["first_duplicate"]


def first_duplicate(keys: Sequence[NDArray[Any]]) -> tuple[int, int] | None:
    """Earliest pair of rows that agree in all keys.

    Rows are hashed to one integer each, so that ten million of them need one sort, not one for each
    key; only rows whose hashes meet are compared in full.

    Parameters
    ----------
    keys : sequence of ndarray, shape (N,)
        Of 8 bytes an element; -0.0 and 0.0 are equal.

    Returns
    -------
    tuple of int, or None
        Indices of a row and of its first repetition; None where no row repeats.
    """
    n = len(keys[0])
    bits = []
    for key in keys:
        key = key + 0.0 if key.dtype.kind == "f" else key  # -0.0 equals 0.0
        bits.append(np.ascontiguousarray(key).view(np.uint64))
    hashed = np.zeros(n, np.uint64)
    for b in bits:
        hashed = (hashed ^ b) * np.uint64(0x9E3779B97F4A7C15)
        hashed ^= hashed >> np.uint64(29)
    ordered = np.sort(hashed)
    twice = np.unique(ordered[1:][ordered[1:] == ordered[:-1]])
    if not len(twice):
        return None
    seen: dict[bytes, int] = {}
    for index in np.flatnonzero(np.isin(hashed, twice)):
        row = b"".join(b[index].tobytes() for b in bits)
        if row in seen:
            return seen[row], int(index)
        seen[row] = int(index)
    return None
