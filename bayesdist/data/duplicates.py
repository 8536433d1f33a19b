"""Rows that stand twice in a table, whether it is held in memory or streams by.

Rows are hashed to one integer each, so that ten million of them need one sort, not one for each
key; only rows whose hashes meet are compared in full.  A table that streams by is gone through
once for every `HELD` rows, and each time the hashes of one residue class are held.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["HELD", "first_duplicate", "first_repetition", "rounds_for"]

UInt = NDArray[np.uint64]
Keys = Sequence[NDArray[Any]]
Batches = Callable[[], Iterable[Keys]]

HELD = 8_000_000  # hashes in memory at a time
_COMPARED = 100_000  # hashes that rows are compared in full for at a time
_BLOCK = 16_384  # rows hashed together: their keys stay in the cache
_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)
_SHIFT = np.uint64(29)


def first_duplicate(keys: Keys) -> tuple[int, int] | None:
    """A pair of rows that agree in all keys.

    Parameters
    ----------
    keys : sequence of ndarray, shape (N,)
        Of 8 bytes an element; -0.0 and 0.0 are equal.

    Returns
    -------
    tuple of int, or None
        Indices of a row and of its first repetition, the pair that `first_repetition` names; None
        where no row repeats.
    """
    return first_repetition(lambda: (keys,), 1)


def rounds_for(n_rows: int) -> int:
    """How many times a table of `n_rows` rows is to be gone through."""
    return max(1, -(-n_rows // HELD))


def first_repetition(batches: Batches, rounds: int) -> tuple[int, int] | None:
    """A pair of rows that agree in all keys, of a table that is gone through batch by batch.

    Parameters
    ----------
    batches : callable
        Gives the table anew at each call: an iterable of batches of rows, each a sequence of keys
        as `first_duplicate` takes them.
    rounds : int
        1 / `rounds` of the hashes are held at a time.

    Returns
    -------
    tuple of int, or None
        Row numbers, counted over all batches, of a row and of its first repetition; None where no
        row repeats.  It is the earliest such pair, unless more than 100 000 different rows repeat:
        then it is the earliest of the first of them that come to light.
    """
    waiting: list[UInt] = []
    for k in range(rounds):
        waiting.append(_repeated(_hashes_of_round(batches, k, rounds)))
        if k < rounds - 1 and sum(len(w) for w in waiting) <= _COMPARED:
            continue
        repeated, waiting = np.concatenate(waiting), []
        for a in range(0, len(repeated), _COMPARED):
            pair = _first_of(batches, np.sort(repeated[a : a + _COMPARED]))
            if pair is not None:
                return pair
    return None


def _bits(keys: Keys) -> list[UInt]:
    """Keys as integers that are equal where the keys are."""
    out = []
    for key in keys:
        key = key + 0.0 if key.dtype.kind == "f" else key  # -0.0 equals 0.0
        out.append(np.ascontiguousarray(key).view(np.uint64))
    return out


def _hashed(keys: Keys) -> UInt:
    """One integer for each row."""
    n = len(keys[0])
    out = np.zeros(n, np.uint64)
    for a in range(0, n, _BLOCK):
        h = out[a : a + _BLOCK]
        for b in _bits([key[a : a + _BLOCK] for key in keys]):
            h ^= b
            h *= _MULTIPLIER
            h ^= h >> _SHIFT
    return out


def _hashes_of_round(batches: Batches, k: int, rounds: int) -> UInt:
    """The hashes of one residue class."""
    found = []
    for keys in batches():
        hashed = _hashed(keys)
        if rounds > 1:
            # of the upper half: the lower bits of a product see the lower bits of its factors only
            hashed = hashed[(hashed >> np.uint64(32)) % np.uint64(rounds) == k]
        found.append(hashed)
    return np.concatenate(found) if found else np.zeros(0, np.uint64)


def _repeated(hashed: UInt) -> UInt:
    """Hashes that stand more than once; the array is sorted in place."""
    hashed.sort()
    twice = hashed[1:][hashed[1:] == hashed[:-1]]
    return np.unique(twice)


def _first_of(batches: Batches, repeated: UInt) -> tuple[int, int] | None:
    """Earliest pair of equal rows among those with certain hashes, in rising order."""
    seen: dict[bytes, int] = {}
    start = 0
    for keys in batches():
        hashed = _hashed(keys)
        slot = np.minimum(np.searchsorted(repeated, hashed), len(repeated) - 1)
        for index in np.flatnonzero(repeated[slot] == hashed).tolist():
            row = b"".join(b.tobytes() for b in _bits([k[index : index + 1] for k in keys]))
            if row in seen:
                return seen[row], start + index
            seen[row] = start + index
        start += len(hashed)
    return None
