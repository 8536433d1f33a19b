"""Grouping of detections into stars by friends of friends, on positions common to all exposures.

The sky is divided into cells that are grouped separately, each with a margin around it. A group
belongs to the cell of its first detection and extends no farther than `MAX_EXTENT`, so that it is
complete in that cell: groups do not depend on the division of the sky.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from bayesdist.data.detections import NO_STAR
from bayesdist.utils.arrays import Bool, Float, Int

FINE = 16  # grid squares per linking length; detections in one square are always friends
MAX_EXTENT = 3.0  # linking lengths; a longer group is a chain of several stars
MARGIN = 5  # linking lengths around a cell, enough for groups that begin in it and their neighbours
MIN_SIDE = 16 * MARGIN  # linking lengths; the margin would dominate smaller cells
EQUAL = 6  # digits after the decimal point to which distances in linking lengths are compared
CELL = 2**16  # average number of detections; their columns fit into the cache of a core

# applies a function to all cells in order: `map`, or its equivalent on a cluster
Each = Callable[[Callable[..., "Grouped"], Iterable["Cell"]], Iterable["Grouped"]]


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
    """Groups with their first detection in a cell."""

    rows: Int  # (m,) rows of detections that belong to stars
    first: Int  # (m,) first row of the star of each detection
    n_doubled: int
    n_dropped: int
    chained: Int  # (k,) rows of chains that reach into the cell, including those in its margin
    chain: Int  # (k,) number of the chain, counted within the cell


def friends_of_friends(places: Float, exposure: Int, length: float, *, each: Each = map) -> Friends:
    """Groups of detections (N, 2) that are connected by steps of at most one linking length.

    Distances are exact to a sixteenth of the linking length: positions are rounded to a grid, which
    reduces the many detections of a star to a few points. Star codes are in the order of the first
    detections. `each` applies a function to the cells, by default one after another in this
    process.
    """
    first = np.full(len(places), NO_STAR)
    n_doubled, n_dropped, chains = 0, 0, list[tuple[Int, Int]]()
    for cell_groups in each(grouped, cells(places, exposure, length, CELL)):
        first[cell_groups.rows] = cell_groups.first
        n_doubled, n_dropped = n_doubled + cell_groups.n_doubled, n_dropped + cell_groups.n_dropped
        chains.append((cell_groups.chained, cell_groups.chain))
    good = np.flatnonzero(first != NO_STAR)
    code = np.cumsum(first == np.arange(len(first))) - 1
    star = np.full(len(first), NO_STAR)
    star[good] = code[first[good]]
    return Friends(star, int(code[-1]) + 1, n_doubled, n_dropped, _joined(chains))


def cells(places: Float, exposure: Int, length: float, detections: int) -> Iterator[Cell]:
    """Sky cells with roughly `detections` detections each; empty cells are omitted."""
    square = _squares(places, length)
    extent = square.max(axis=1) + 1.0
    side = int(np.sqrt(detections / len(places) * extent[0] * extent[1])) + 1
    side, margin = max(side, MIN_SIDE * FINE), MARGIN * FINE
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
    """Grid squares (2, N), counted from the lowest one; the grid is common to all cells."""
    lowest, highest = (np.floor(end / (length / FINE)) for end in (places.min(0), places.max(0)))
    narrow = (highest - lowest).max() < np.iinfo(np.int32).max
    square = np.empty((2, len(places)), np.int32 if narrow else np.int64)
    for axis in range(2):
        square[axis] = np.floor(places[:, axis] / (length / FINE)) - lowest[axis]
    return square


def _within(square: Int, low: Int, high: Int) -> Bool:
    """Boolean mask (n,) of squares (2, n) from low (2,) up to, but not including, high (2,)."""
    (i, j), (a, b), (c, d) = square, low, high
    return np.asarray((i >= a) & (i < c) & (j >= b) & (j < d))


def grouped(cell: Cell) -> Grouped:
    """Groups of a cell."""
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
