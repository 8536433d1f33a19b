"""Rows that occur repeatedly, and reference stars that occur in several rows.

**Reference stars.** Rows of one star share the error of its reference position. Tables often lack a
column that identifies the star; rows with equal reference positions then belong to one star. Stars
may also form tight groups, such as the pinholes of a fiducial, with position errors that are common
to the group.

**Repeated rows** are found in a table that is in memory or streamed. Each row is hashed to one
integer, so that ten million rows need one sort instead of one per key. Only rows with equal hashes
are compared in full. For a streamed table, hashes are sorted into buckets of about `HELD` in a
scratch file, which are then processed one by one: the cost grows linearly with the number of rows,
and the memory does not grow.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.text import count

# interpretation of rows with equal reference positions: reading option `same_position`
SAME_POSITION = ("one_star", "separate_stars")
ROUNDING = 1e-9  # fraction of the field; positions closer than this are equal
# Linking length of tight groups, in units of the square root of the area per star. If stars are
# distributed at random, 7 % have a neighbour within it.
LINK = 0.15
LARGEST_GROUP = 30  # stars; larger groups indicate a crowded field, not a fiducial
# smallest distance of a group from the next star, in units of the extent of the group
ISOLATION = 4.0
MOST = 0.5  # fraction of the stars that must be in groups
MIN_STARS = 20  # with fewer stars, groups cannot be distinguished from chance
UInt = NDArray[np.uint64]
Keys = Sequence[NDArray[Any]]
Batches = Callable[[], Iterable[Keys]]
Hashing = Callable[[Keys], UInt]
HELD = 8_000_000  # number of hashes in memory at a time
COMPARED = 100_000  # number of hashes for which rows are compared in full at a time
_BLOCK = 16_384  # number of rows hashed together, so that their keys stay in the cache
_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)
_SHIFT = np.uint64(29)


def check_same_position(value: str) -> None:
    """Raise InputError unless `value` is one of `SAME_POSITION`."""
    if value not in SAME_POSITION:
        raise InputError(
            f"same_position is {value!r}",
            where="data.same_position",
            do=f"set it to {' or '.join(map(repr, SAME_POSITION))}",
        )


def position_codes(first: Float, second: Float) -> Int:
    """Code (N,) of the distinct position of each row; equal within rounding counts as equal.

    `first` and `second` (N,) are the two coordinates.  Codes count from 0 in ascending order of the
    positions, independent of the order of the rows.
    """
    # -0.0 and 0.0 are equal
    distinct, code = np.unique((first + 0.0) + 1j * (second + 0.0), return_inverse=True)
    at = np.column_stack([distinct.real, distinct.imag])
    tolerance = ROUNDING * float(max(np.ptp(at, axis=0).max(), 1e-300))
    pairs = cKDTree(at).query_pairs(tolerance, output_type="ndarray")
    if not len(pairs):
        return np.asarray(code)
    _, merged = _linked(pairs, len(at))
    return np.asarray(merged[code])


def star_codes(first: Float, second: Float, same_position: str) -> tuple[Int | None, str]:
    """Codes (N,) of stars from their reference positions, and a note about them.

    `first` and `second` (N,) are the coordinates.  If no position occurs twice, the codes are None
    and the note is empty.  `same_position` is the option of `ReadOptions`.  With 'separate_stars'
    each row gets a different code, so that equal positions are not searched for again.
    """
    code = position_codes(first, second)
    number = np.bincount(code)
    repeated = number[number > 1]
    if not repeated.size:
        return None, ""
    words = repeated_words(repeated)
    if same_position == "separate_stars":
        return np.arange(len(code)), f"{words}, and count as separate stars (data.same_position)"
    return code, f"{words}: their matches count as those of one star (data.same_position)"


def repeated_words(number: Int) -> str:
    """Clause on reference positions that occur in several rows; `number` is the count of each."""
    low, high = int(number.min()), int(number.max())
    times = f"{low}" if low == high else f"{low} to {high}"
    is_single = len(number) == 1
    verb = "position occurs" if is_single else "positions occur"
    return f"{count(len(number))} reference {verb} {times} times" + ("" if is_single else " each")


@dataclass(frozen=True, eq=False)
class RepeatedDetections:
    """Stars with several detections in one exposure; at most one of them can be correct."""

    stars: int  # reference stars with several detections in an exposure
    rows: int  # rows of these stars in these exposures
    n_stars: int  # total number of reference stars
    # True if there is only one exposure and most stars occur several times in it: probably several
    # exposures that no column distinguishes
    unlabelled: bool

    @property
    def sentence(self) -> str:
        """Sentence that states the problem and how to solve it."""
        if self.unlabelled:
            return (
                f"{count(self.stars)} of {count(self.n_stars)} stars have several detections, and "
                "no column tells exposures apart: name the column of the exposures (exposure in "
                "data.columns); within one exposure all but one of them would be false matches"
            )
        return (
            f"{count(self.stars)} of {count(self.n_stars)} stars have several detections in one "
            f"exposure ({count(self.rows)} rows), of which at most one of each star can be right: "
            "match one to one (bayesdist match, bayesdist.match), or keep the nearest of each star"
        )


def repeated_detections(
    u: Float, v: Float, exposure: Int, star: Int | None
) -> RepeatedDetections | None:
    """Stars that occur several times in one exposure; None if there are none.

    Rows of an exposure are detections of the same star if they have the same reference position
    and, if `star` (N,) is given, the same code.
    """
    position = position_codes(u, v)
    # distinguish separate stars at one position, and members of a group with one code
    code = position if star is None else _joint(star, position)
    cell = _joint(exposure, code)
    number = np.bincount(cell)
    several = number[cell] > 1
    if not several.any():
        return None
    stars, n_stars = len(np.unique(code[several])), len(np.unique(code))
    unlabelled = len(np.unique(exposure)) == 1 and 2 * stars > n_stars
    return RepeatedDetections(stars, int(several.sum()), n_stars, unlabelled)


@dataclass(frozen=True, eq=False)
class TightGroups:
    """Stars in groups that are far tighter than the distances between the groups."""

    code: Int  # (N,) group of each row; a star outside of any group is a group of one
    groups: int  # number of groups with several stars
    size: int  # median number of stars in groups with several stars
    extent: float  # median largest extent of a group, in the unit of u, v
    apart: float  # median distance between neighbouring groups

    def sentence(self, unit: str) -> str:
        """Sentence that states the problem and how to solve it; `unit` is that of u, v."""
        return (
            f"the stars lie in {count(self.groups)} groups of {self.size} (extent "
            f"{self.extent:.2g} {unit}, {self.apart:.2g} {unit} apart), and stars of a group are "
            "taken to share an error: give a column star with the number of the group (the "
            "fiducial), or of each star if their errors are independent"
        )


def tight_groups(u: Float, v: Float, star: Int | None = None) -> TightGroups | None:
    """Tight groups of reference positions; None if most stars are isolated.

    Rows with the same code in `star` (N,) are one star at their mean position.
    """
    code = position_codes(u, v) if star is None else np.unique(star, return_inverse=True)[1]
    number = np.bincount(code)
    n = len(number)
    if n < MIN_STARS:
        return None
    at = np.column_stack([np.bincount(code, z) / number for z in (u, v)])
    area = float(np.prod(np.maximum(np.ptp(at, axis=0), 1e-300)))
    link = LINK * np.sqrt(area / n)
    tree = cKDTree(at)
    near, _ = tree.query(at, k=2)
    if (near[:, 1] <= link).mean() < MOST:
        return None
    # many pairs mean a crowded field, in which groups would be larger than any fiducial
    if tree.count_neighbors(tree, link) > n * LARGEST_GROUP:
        return None
    pairs = tree.query_pairs(link, output_type="ndarray")
    n_groups, group = _linked(pairs, n)
    size = np.bincount(group)
    low, high = np.full((n_groups, 2), np.inf), np.full((n_groups, 2), -np.inf)
    np.minimum.at(low, group, at)
    np.maximum.at(high, group, at)
    extent = np.hypot(*(high - low).T)
    centre = np.column_stack([np.bincount(group, z) / size for z in at.T])
    if n_groups < 2:
        return None
    apart = cKDTree(centre).query(centre, k=2)[0][:, 1]
    # stars at one position have different codes by request: their errors are independent
    distinct = extent > ROUNDING * float(np.ptp(at, axis=0).max())
    isolated = distinct & (size <= LARGEST_GROUP) & (apart > ISOLATION * extent)
    if size[isolated].sum() < MOST * n:
        return None
    return TightGroups(
        group[code],  # includes groups that are not isolated, because most groups are
        int(isolated.sum()),
        int(np.median(size[isolated])),
        float(np.median(extent[isolated])),
        float(np.median(apart[isolated])),
    )


def error_codes(u: Float, v: Float, star: Int | None) -> Int | None:
    """Code (N,) of the star, or tight group of stars, that shares a reference error.

    The result is None if each row is a separate star.
    """
    groups = tight_groups(u, v, star)
    return star if groups is None else groups.code


def _joint(a: Int, b: Int) -> Int:
    """Code (N,) from 0 for each distinct pair of codes."""
    keys = np.unique(a, return_inverse=True)[1] * (int(b.max(initial=0)) + 1) + b
    return np.asarray(np.unique(keys, return_inverse=True)[1])


def _linked(pairs: Sequence[Int] | Int, n: int) -> tuple[int, Int]:
    """Number of connected components of n points, and the component of each point."""
    i, j = np.asarray(pairs).T
    return connected_components(coo_array((np.ones(len(i)), (i, j)), shape=(n, n)), directed=False)


def _bits(keys: Keys) -> list[UInt]:
    """Keys as integers that are equal if the keys are equal."""
    out = []
    for key in keys:
        key = key + 0.0 if key.dtype.kind == "f" else key  # -0.0 equals 0.0
        out.append(np.ascontiguousarray(key).view(np.uint64))
    return out


def row_hashes(keys: Keys) -> UInt:
    """Integer hash (N,) of each row; `keys` are the columns (N,)."""
    n = len(keys[0])
    out = np.zeros(n, np.uint64)
    for a in range(0, n, _BLOCK):
        h = out[a : a + _BLOCK]
        for b in _bits([key[a : a + _BLOCK] for key in keys]):
            h ^= b
            h *= _MULTIPLIER
            h ^= h >> _SHIFT
    return out


def first_duplicate(keys: Keys, *, hashing: Hashing = row_hashes) -> tuple[int, int] | None:
    """Indices of a row and of its first repetition; None if no row repeats.

    Rows are compared in all columns `keys` (N,), after a search by their hashes.
    """
    return first_repetition(lambda: (keys,), 1, hashing=hashing)


def buckets_for(n_rows: int) -> int:
    """Number of buckets for the hashes of `n_rows` rows."""
    return max(1, -(-n_rows // HELD))


def first_repetition(
    batches: Batches,
    buckets: int,
    *,
    hashing: Hashing = row_hashes,
    at_once: int = COMPARED,
) -> tuple[int, int] | None:
    """Row numbers of a row and of its first repetition in all keys; None if no row repeats.

    `batches` returns, at each call, an iterable over the batches of the table from its beginning.
    Each batch is a sequence of keys as for `first_duplicate`. A fraction 1 / `buckets` of the
    hashes is in memory at a time. `hashing` returns an integer per row. `at_once` is the number of
    repeated hashes for which rows are compared in full at a time: the pair is the earliest one
    among the first of them. Raises InputError if the scratch folder is full.
    """
    waiting: list[UInt] = []
    for k, hashes in enumerate(_bucketed(batches, buckets, hashing)):
        waiting.append(_repeated(hashes))
        if k < buckets - 1 and sum(len(w) for w in waiting) <= at_once:
            continue
        repeated, waiting = np.concatenate(waiting), []
        for a in range(0, len(repeated), at_once):
            pair = _first_of(batches, np.sort(repeated[a : a + at_once]), hashing)
            if pair is not None:
                return pair
    return None


def _bucketed(batches: Batches, buckets: int, hashing: Hashing) -> Iterator[UInt]:
    """Hashes of each bucket; the table is read once."""
    if buckets == 1:
        hashes_of_batches = [hashing(keys) for keys in batches()]
        yield np.concatenate(hashes_of_batches) if hashes_of_batches else np.zeros(0, np.uint64)
        return
    edges: list[Int] = []  # positions in the file of the buckets of each batch
    with tempfile.TemporaryFile(prefix="bayesdist-") as file:
        try:
            for hashed in _joined(hashing(keys) for keys in batches()):
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


def _first_of(batches: Batches, repeated: UInt, hashing: Hashing) -> tuple[int, int] | None:
    """Earliest pair of equal rows among those with the hashes `repeated`, which are ascending."""
    row_of_bytes: dict[bytes, int] = {}
    start = 0
    for keys in batches():
        hashed = hashing(keys)
        slot = np.minimum(np.searchsorted(repeated, hashed), len(repeated) - 1)
        for index in np.flatnonzero(repeated[slot] == hashed).tolist():
            row = b"".join(b.tobytes() for b in _bits([k[index : index + 1] for k in keys]))
            if row in row_of_bytes:
                return row_of_bytes[row], start + index
            row_of_bytes[row] = start + index
        start += len(hashed)
    return None
