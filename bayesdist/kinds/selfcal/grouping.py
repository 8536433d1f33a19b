"""Detections of one field matched with each other, without a catalogue.

**Maps between exposures.**  Linear maps bring the exposures of one field onto the plane of the
first exposure. Each exposure is recognised by the patterns of its bright stars among the stars of
the exposures that are already mapped. Its remaining stars are then added to these. Exposures that
do not overlap with the first one are thereby connected through others.

**Stars.**  Detections are grouped into stars by friends of friends, on positions common to all
exposures. The sky is divided into cells that are grouped separately, each with a margin around it.
A group belongs to the cell of its first detection and extends no farther than `MAX_EXTENT`, so that
it is complete in that cell: groups do not depend on the division of the sky.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from bayesdist.data.detections import NO_STAR
from bayesdist.data.matching.pairs import LinearMap
from bayesdist.data.matching.similarity import (
    PatternIndex,
    find_similarity,
    grown_map,
    pattern_index,
)
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Bool, Float, Int

BRIGHT_STARS = 3000  # number of bright stars of an exposure that are used
WIDE = 0.3  # of the spacing; stars farther than this from all others are new
NARROW = 0.1  # of the spacing; final search radius of the linear map
MAX_COMMON_FRACTION = 0.5  # fraction of equal positions above which two exposures are identical
SCALES = (0.97, 1.03)
FINE = 16  # grid squares per linking length; detections in one square are always friends
MAX_EXTENT = 3.0  # linking lengths; a longer group is a chain of several stars
MARGIN = 5  # linking lengths around a cell, enough for groups that begin in it and their neighbours
MIN_SIDE = 16 * MARGIN  # linking lengths; the margin would dominate smaller cells
EQUAL = 6  # digits after the decimal point to which distances in linking lengths are compared
CELL = 2**16  # average number of detections; their columns fit into the cache of a core
# applies a function to all cells in order: `map`, or its equivalent on a cluster
Each = Callable[[Callable[..., "Grouped"], Iterable["Cell"]], Iterable["Grouped"]]


@dataclass(frozen=True, eq=False)
class MutualFrames:
    """Linear maps of exposures: position on the plane of the first = matrix @ position + shift."""

    matrices: Float  # (E, 2, 2)
    shifts: Float  # (E, 2)

    @property
    def rotations(self) -> Float:
        """Rotations (E,) in radians of the similarities closest to the matrices."""
        M = self.matrices
        return np.asarray(np.arctan2(M[:, 1, 0] - M[:, 0, 1], M[:, 0, 0] + M[:, 1, 1]))


def mutual_frames(
    planes: Sequence[Float],
    mags: Sequence[Float] | None,
    names: Sequence[str],
    *,
    source: str = "star lists",
) -> MutualFrames:
    """Linear maps of all exposures onto the plane of the first one.

    `planes` has the positions (N_e, 2) in each exposure after the known distortion.  If magnitudes
    `mags` are given, only bright stars are used.  Raises InputError if the exposures form several
    groups without common stars; the message lists the groups.
    """
    groups = _groups(planes, mags)
    if len(groups) > 1:
        listed = "; ".join(_listed([names[e] for e in group]) for group in groups)
        raise InputError(
            f"the exposures fall into {len(groups)} groups without stars in common: {listed}",
            where=source,
            do="add exposures between them, calibrate each group by itself, or name an "
            "initial_distortion with which their stars agree",
        )
    maps = groups[0]
    E = len(planes)
    matrices, shifts = np.empty((E, 2, 2)), np.empty((E, 2))
    for e, linear_map in maps.items():
        matrices[e] = linear_map.matrix
        shifts[e] = linear_map(np.zeros((1, 2)))[0]
    return MutualFrames(matrices, shifts)


def refuse_duplicates(
    pixels: Sequence[Float], names: Sequence[str], *, source: str = "star lists"
) -> None:
    """Raise InputError if two exposures have the same detections.

    `pixels` has the raw positions (N_e, 2) of each exposure.
    """
    rows = [{tuple(row) for row in np.round(positions, 6).tolist()} for positions in pixels]
    for b in range(len(rows)):
        for a in range(b):
            if len(rows[a] & rows[b]) > MAX_COMMON_FRACTION * min(len(rows[a]), len(rows[b])):
                raise InputError(
                    f"exposures {names[a]} and {names[b]} have the same detections",
                    where=source,
                    do="leave one of them out: it adds no information",
                )


def _groups(planes: Sequence[Float], mags: Sequence[Float] | None) -> list[dict[int, LinearMap]]:
    """Groups of connected exposures, each with the maps onto the first exposure of the group."""
    bright = [_brightest(planes[e], None if mags is None else mags[e]) for e in range(len(planes))]
    remaining, out = list(range(len(planes))), list[dict[int, LinearMap]]()
    while remaining:
        first = remaining.pop(0)
        maps = {first: LinearMap(np.eye(2), np.zeros(2), np.zeros(2))}
        master, magnitude = planes[first][bright[first]], _of(mags, first, bright[first])
        fresh = True
        while fresh and remaining:
            fresh = False
            index = pattern_index(master, magnitude)
            for e in tuple(remaining):
                points = planes[e][bright[e]]
                linear_map = _onto(points, _of(mags, e, bright[e]), index)
                if linear_map is None:
                    continue
                remaining.remove(e)
                maps[e] = linear_map
                fresh = True
                moved = linear_map(points)
                distance, _ = cKDTree(master).query(moved)
                new = distance > index.spacing * WIDE
                master = np.concatenate([master, moved[new]])
                if magnitude is not None and mags is not None:
                    magnitude = np.concatenate([magnitude, mags[e][bright[e]][new]])
        out.append(maps)
    return out


def _onto(points: Float, mag: Float | None, index: PatternIndex) -> LinearMap | None:
    """Linear map of an exposure onto the indexed stars; None if it is not recognised."""
    try:
        similarity = find_similarity(points, index, mag=mag, scale=SCALES)
    except InputError:
        return None
    return grown_map(points, similarity, index, narrow=NARROW)


def _brightest(plane: Float, mag: Float | None) -> Int:
    if mag is None or len(plane) <= BRIGHT_STARS:
        return np.arange(len(plane))
    return np.sort(np.argsort(mag, kind="stable")[:BRIGHT_STARS])


def _of(mags: Sequence[Float] | None, e: int, rows: Int) -> Float | None:
    return None if mags is None else mags[e][rows]


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(names[:4])
    return f"({shown}{f' and {len(names) - 4} more' if len(names) > 4 else ''})"


@dataclass(frozen=True, eq=False)
class Friends:
    """Stars found among detections (N,)."""

    star: Int  # (N,) star codes from 0; `NO_STAR` for dropped detections
    n_stars: int
    # groups with several detections in one exposure; the one nearest to the mean is kept
    n_doubled: int
    n_dropped: int  # detections dropped for that reason
    n_chains: int  # groups that were dropped because they span several stars

    @property
    def n_ambiguous(self) -> int:
        """Number of groups that may not be single stars."""
        return self.n_doubled + self.n_chains


@dataclass(frozen=True, eq=False)
class Cell:
    """Detections in a cell of the sky and in its margin."""

    rows: Int  # (n,) ascending
    places: Float  # (n, 2)
    exposure: Int  # (n,)
    inside: Bool  # (n,) True for detections in the cell itself
    length: float  # linking length


@dataclass(frozen=True, eq=False)
class Grouped:
    """Groups of a cell, each of which has its first detection in that cell."""

    rows: Int  # (m,) rows of detections that belong to stars
    first: Int  # (m,) first row of the star of each detection
    n_doubled: int
    n_dropped: int
    chained: Int  # (k,) rows of chains that reach into the cell, including those in its margin
    chain: Int  # (k,) number of the chain, counted within the cell


def friends_of_friends(
    places: Float, exposure: Int, length: float, *, each: Each = map, per_cell: int | None = None
) -> Friends:
    """Stars: groups of detections (N, 2) connected by steps of at most one linking length.

    `length` is the linking length, in the unit of `places`, and `exposure` (N,) are exposure codes.
    Distances are exact to a sixteenth of the linking length: positions are rounded to a grid, which
    reduces the many detections of a star to a few points.  Star codes are in the order of the first
    detections.  `each` applies a function to the cells, by default one after another in this
    process. `per_cell` is the average number of detections per cell (default: `CELL`); the result
    does not depend on it.
    """
    first = np.full(len(places), NO_STAR)
    n_doubled, n_dropped, chains = 0, 0, list[tuple[Int, Int]]()
    for cell_groups in each(grouped, cells(places, exposure, length, per_cell or CELL)):
        first[cell_groups.rows] = cell_groups.first
        n_doubled, n_dropped = n_doubled + cell_groups.n_doubled, n_dropped + cell_groups.n_dropped
        chains.append((cell_groups.chained, cell_groups.chain))
    good = np.flatnonzero(first != NO_STAR)
    code = np.cumsum(first == np.arange(len(first))) - 1
    star = np.full(len(first), NO_STAR)
    star[good] = code[first[good]]
    return Friends(star, int(code[-1]) + 1, n_doubled, n_dropped, _joined(chains))


def cells(places: Float, exposure: Int, length: float, detections: int) -> Iterator[Cell]:
    """Yield sky cells with roughly `detections` detections each; empty cells are omitted.

    `places` are the positions (N, 2) and `length` is the match length, in the same unit.
    """
    square = _squares(places, length)
    extent = square.max(axis=1) + 1.0
    side = int(np.sqrt(detections / len(places) * extent[0] * extent[1])) + 1
    # few detections may be so far apart that a cell would be larger than any square has a number
    side = min(max(side, MIN_SIDE * FINE), int(np.iinfo(square.dtype).max))
    margin = MARGIN * FINE
    n_lines = int(square[1].max()) // side + 3  # the first and the last line are empty
    cell = (square[0] // side + np.int64(1)) * n_lines + square[1] // side + 1
    order = np.argsort(cell, kind="stable")
    cell, square = cell[order], square[:, order]
    for number in np.unique(cell):
        low = side * (np.array(divmod(int(number), n_lines)) - 1)
        high = low + side
        # a cell and its eight neighbours; the three in a column have consecutive numbers
        middles = number + n_lines * np.array([-1, 0, 1])
        ends = np.searchsorted(cell, [middles - 1, middles + 2]).T
        at = np.concatenate(
            [
                a + np.flatnonzero(_within(square[:, a:b], low - margin, high + margin))
                for a, b in ends
            ]
        )
        at = at[np.argsort(order[at])]
        rows = order[at]
        yield Cell(rows, places[rows], exposure[rows], _within(square[:, at], low, high), length)


def _squares(places: Float, length: float) -> Int:
    """Grid squares (2, N), counted from the lowest one; the grid is common to all cells.

    Raises InputError if a place is so far from the others that the grid has too many squares.
    """
    lowest, highest = (np.floor(end / (length / FINE)) for end in (places.min(0), places.max(0)))
    if (highest - lowest).max() > np.iinfo(np.int32).max:
        far = int(np.argmax(np.abs(places - np.median(places, axis=0)).max(axis=1)))
        raise InputError(
            f"detection {far + 1} of all lists is too far from the others to be matched: "
            f"{np.abs(places[far]).max():.3g} from the zero point, with match length {length:.3g}",
            where="selfcal.lists",
            do="correct x and y of the lists, or the initial distortion",
        )
    square: NDArray[Any] = np.empty((2, len(places)), np.int32)  # half of the memory of int64
    for axis in range(2):
        square[axis] = np.floor(places[:, axis] / (length / FINE)) - lowest[axis]
    return square


def _within(square: Int, low: Int, high: Int) -> Bool:
    """Boolean mask (n,) of squares (2, n) from low (2,) up to, but not including, high (2,)."""
    (i, j), (a, b), (c, d) = square, low, high
    return np.asarray((i >= a) & (i < c) & (j >= b) & (j < d))


def grouped(cell: Cell) -> Grouped:
    """Groups of detections in a cell that are connected by the linking length."""
    places, rows = cell.places, cell.rows
    column, line = _squares(places, cell.length)
    key = column * (line.max() + np.int64(1)) + line
    _, representatives, of_square = np.unique(key, return_index=True, return_inverse=True)
    pairs = cKDTree(places[representatives]).query_pairs(cell.length, output_type="ndarray")
    links = coo_array(
        (np.ones(len(pairs), bool), tuple(pairs.T)), shape=(len(representatives),) * 2
    )
    n, group_of_square = connected_components(links, directed=False)
    # int64, because codes of groups and exposures are multiplied
    group = group_of_square[of_square].astype(np.int64)
    chain = _spans(places, group, n) > MAX_EXTENT * cell.length
    reaches = np.zeros(n, bool)
    reaches[group[cell.inside]] = True  # the first detection of a chain may be outside of the cell
    chained = (chain & reaches)[group]
    heads = np.full(n, len(rows))
    np.minimum.at(heads, group, np.arange(len(rows)))
    belongs = cell.inside[heads] & ~chain
    second = _seconds(places / cell.length, cell.exposure, group, belongs)
    selected = belongs[group]
    selected[second] = False
    stars, star_rows = group[selected], rows[selected]
    # first remaining detection of each group
    first = np.full(n, NO_STAR)
    first[stars[::-1]] = star_rows[::-1]
    doubled = len(np.unique(group[second]))
    return Grouped(star_rows, first[stars], doubled, len(second), rows[chained], group[chained])


def _spans(places: Float, group: Int, n: int) -> Float:
    """Longer side (n,) of the box around each group."""
    span = np.zeros(n)
    for axis in range(2):
        low, high = np.full(n, np.inf), np.full(n, -np.inf)
        np.minimum.at(low, group, places[:, axis])
        np.maximum.at(high, group, places[:, axis])
        span = np.maximum(span, high - low)
    return span


def _seconds(places: Float, exposure: Int, group: Int, own: Bool) -> Int:
    """Indices of detections that are not the nearest to the group's mean in their exposure.

    Only groups with `own` (n,) True are considered. `places` are in linking lengths. The mean of
    two detections has the same distance from both; distances are rounded so that the first one is
    kept.
    """
    key = group * (int(exposure.max()) + 1) + exposure
    order = np.argsort(key, kind="stable")
    is_repeat = key[order][1:] == key[order][:-1]
    several = np.zeros(len(key), bool)
    several[order[1:][is_repeat]] = several[order[:-1][is_repeat]] = True
    several &= own[group]
    at = np.flatnonzero(several)
    counts = np.bincount(group)
    middle = np.stack([np.bincount(group, places[:, axis]) / counts for axis in (0, 1)], axis=1)
    distance = np.round(np.hypot(*(places[at] - middle[group[at]]).T), EQUAL)
    at = at[np.lexsort((distance, key[at]))]
    return at[1:][key[at][1:] == key[at][:-1]]


def _joined(chains: list[tuple[Int, Int]]) -> int:
    """Number of chains, after joining the parts that different cells see and that share rows."""
    rows = np.unique(np.concatenate([rows for rows, _ in chains]), return_inverse=True)[1]
    sizes = [int(chain.max(initial=-1)) + 1 for _, chain in chains]
    begins = np.cumsum([0, *sizes[:-1]])
    part = np.concatenate([begin + chain for begin, (_, chain) in zip(begins, chains, strict=True)])
    part = np.unique(part, return_inverse=True)[1]
    n = int(part.max(initial=-1)) + 1
    size = n + int(rows.max(initial=-1)) + 1
    links = coo_array((np.ones(len(part), bool), (part, n + rows)), shape=(size, size))
    return int(connected_components(links, directed=False)[0]) if n else 0
