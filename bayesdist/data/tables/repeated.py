"""Search for repeated rows in a table that is in memory or streamed.

Each row is hashed to one integer, so that ten million rows need one sort instead of one per key.
Only rows with equal hashes are compared in full. For a streamed table, hashes are sorted into
buckets of about `HELD` in a scratch file, which are then processed one by one: the cost grows
linearly with the number of rows, and the memory does not grow.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Int

UInt = NDArray[np.uint64]
Keys = Sequence[NDArray[Any]]
Batches = Callable[[], Iterable[Keys]]

HELD = 8_000_000  # number of hashes in memory at a time
_COMPARED = 100_000  # number of hashes for which rows are compared in full at a time
_BLOCK = 16_384  # number of rows hashed together, so that their keys stay in the cache
_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)
_SHIFT = np.uint64(29)


def first_duplicate(keys: Keys) -> tuple[int, int] | None:
    """Indices of a row and of its first repetition in all keys (N,); None if no row repeats."""
    return first_repetition(lambda: (keys,), 1)


def buckets_for(n_rows: int) -> int:
    """Number of buckets for the hashes of `n_rows` rows."""
    return max(1, -(-n_rows // HELD))


def first_repetition(batches: Batches, buckets: int) -> tuple[int, int] | None:
    """Row numbers of a row and of its first repetition in all keys; None if no row repeats.

    `batches` returns, at each call, an iterable over the batches of the table from its beginning.
    Each batch is a sequence of keys as for `first_duplicate`. A fraction 1 / `buckets` of the
    hashes is in memory at a time. The pair is the earliest one; if more than 100 000 different rows
    repeat, it is the earliest among the first of them. InputError if the scratch folder is full.
    """
    waiting: list[UInt] = []
    for k, hashes in enumerate(_bucketed(batches, buckets)):
        waiting.append(_repeated(hashes))
        if k < buckets - 1 and sum(len(w) for w in waiting) <= _COMPARED:
            continue
        repeated, waiting = np.concatenate(waiting), []
        for a in range(0, len(repeated), _COMPARED):
            pair = _first_of(batches, np.sort(repeated[a : a + _COMPARED]))
            if pair is not None:
                return pair
    return None


def _bits(keys: Keys) -> list[UInt]:
    """Keys as integers that are equal if the keys are equal."""
    out = []
    for key in keys:
        key = key + 0.0 if key.dtype.kind == "f" else key  # -0.0 equals 0.0
        out.append(np.ascontiguousarray(key).view(np.uint64))
    return out


def _hashed(keys: Keys) -> UInt:
    """One integer hash per row."""
    n = len(keys[0])
    out = np.zeros(n, np.uint64)
    for a in range(0, n, _BLOCK):
        h = out[a : a + _BLOCK]
        for b in _bits([key[a : a + _BLOCK] for key in keys]):
            h ^= b
            h *= _MULTIPLIER
            h ^= h >> _SHIFT
    return out


def _bucketed(batches: Batches, buckets: int) -> Iterator[UInt]:
    """Hashes of each bucket; the table is read once."""
    if buckets == 1:
        hashes_of_batches = [_hashed(keys) for keys in batches()]
        yield np.concatenate(hashes_of_batches) if hashes_of_batches else np.zeros(0, np.uint64)
        return
    edges: list[Int] = []  # positions in the file of the buckets of each batch
    with tempfile.TemporaryFile(prefix="bayesdist-") as file:
        try:
            for hashed in _joined(_hashed(keys) for keys in batches()):
                # use the upper half: the lower bits of a product depend only on the lower bits of
                # its factors
                bucket = (hashed >> np.uint64(32)) % np.uint64(buckets)
                counts = np.bincount(bucket.astype(np.int64), minlength=buckets)
                edges.append(file.tell() + 8 * np.concatenate([[0], np.cumsum(counts)]))
                file.write(hashed[np.argsort(bucket, kind="stable")].data)
            file.flush()
        except OSError as error:
            raise InputError(
                f"the search for repeated rows does not fit into the scratch folder "
                f"({error.strerror})",
                where=tempfile.gettempdir(),
                do="set TMPDIR to a folder with 8 bytes of room for each row",
            ) from error
        for k in range(buckets):
            parts = []
            for begin, end in ((e[k], e[k + 1]) for e in edges):
                file.seek(int(begin))
                parts.append(np.frombuffer(file.read(int(end - begin)), np.uint64))
            yield np.concatenate(parts)


def _joined(parts: Iterable[UInt]) -> Iterator[UInt]:
    """Hashes combined into larger parts, which keeps the list of file positions short."""
    waiting: list[UInt] = []
    for part in parts:
        waiting.append(part)
        if sum(len(w) for w in waiting) >= HELD // 4:
            yield np.concatenate(waiting)
            waiting = []
    if waiting:
        yield np.concatenate(waiting)


def _repeated(hashed: UInt) -> UInt:
    """Hashes that occur more than once; the array is sorted in place."""
    hashed.sort()
    duplicates = hashed[1:][hashed[1:] == hashed[:-1]]
    return np.unique(duplicates)


def _first_of(batches: Batches, repeated: UInt) -> tuple[int, int] | None:
    """Earliest pair of equal rows among those with the hashes `repeated`, which are ascending."""
    row_of_bytes: dict[bytes, int] = {}
    start = 0
    for keys in batches():
        hashed = _hashed(keys)
        slot = np.minimum(np.searchsorted(repeated, hashed), len(repeated) - 1)
        for index in np.flatnonzero(repeated[slot] == hashed).tolist():
            row = b"".join(b.tobytes() for b in _bits([k[index : index + 1] for k in keys]))
            if row in row_of_bytes:
                return row_of_bytes[row], start + index
            row_of_bytes[row] = start + index
        start += len(hashed)
    return None
