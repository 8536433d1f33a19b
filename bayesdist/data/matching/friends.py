"""Detections grouped into stars: friends of friends on positions that exposures have in common.

The sky is cut into cells, and each is grouped by itself, with what lies about it.  A group belongs
to the cell of its first detection and reaches no farther than `MAX_EXTENT`, so that the cell has
all of it: groups do not depend on where the sky is cut.
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

FINE = 16  # grid squares in a linking length: detections in one are friends without a comparison
MAX_EXTENT = 3.0  # linking lengths that a group may span: a longer one is a chain of stars
MARGIN = 5  # linking lengths about a cell: a group that begins in it, and whoever is linked to that
MIN_SIDE = 16 * MARGIN  # linking lengths: smaller cells would be margin for the most part
EQUAL = 6  # digits of a linking length to which distances are compared
CELL = 2**16  # detections, on average: their columns fit into the cache of a core

# function of each source, in their order: `map`, or the same on a cluster
Each = Callable[[Callable[..., "Grouped"], Iterable["Cell"]], Iterable["Grouped"]]


@dataclass(frozen=True, eq=False)
class Friends:
    """Stars that were found among detections (N,)."""

    star: Int  # (N,) codes from 0; `NO_STAR` for detections that were dropped
    n_stars: int
    n_doubled: int  # groups with several detections of one exposure: the nearest to the mean stays
    n_dropped: int  # detections that were dropped for that
    n_chains: int  # groups that were given up, as they span several stars

    @property
    def n_ambiguous(self) -> int:
        """Groups that may not be one star."""
        return self.n_doubled + self.n_chains


@dataclass(frozen=True, eq=False)
class Cell:
    """Detections of a cell of the sky and of its margin."""

    rows: Int  # (n,) ascending
    places: Float  # (n, 2)
    exposure: Int  # (n,)
    inside: Bool  # (n,) without the margin
    length: float  # linking length


@dataclass(frozen=True, eq=False)
class Grouped:
    """Groups whose first detection lies in a cell."""

    rows: Int  # (m,) detections of stars
    first: Int  # (m,) first row of the star of each
    n_doubled: int
    n_dropped: int
    chained: Int  # (k,) rows of chains that reach into the cell, with those in its margin
    chain: Int  # (k,) number, in the cell, of the chain of each


def friends_of_friends(places: Float, exposure: Int, length: float, *, each: Each = map) -> Friends:
    """Groups of detections (N, 2) that are connected by steps no longer than a linking length.

    Distances are exact to a sixteenth of the length: positions are rounded to squares of a grid, so
    that the many detections of one star are a few points.  Codes rise with the first detection of
    the star.  `each` is where the cells are grouped: one after another in this process by default.
    """
    first = np.full(len(places), NO_STAR)
    n_doubled, n_dropped, chains = 0, 0, list[tuple[Int, Int]]()
    for found in each(grouped, cells(places, exposure, length, CELL)):
        first[found.rows] = found.first
        n_doubled, n_dropped = n_doubled + found.n_doubled, n_dropped + found.n_dropped
        chains.append((found.chained, found.chain))
    good = np.flatnonzero(first != NO_STAR)
    code = np.cumsum(first == np.arange(len(first))) - 1
    star = np.full(len(first), NO_STAR)
    star[good] = code[first[good]]
    return Friends(star, int(code[-1]) + 1, n_doubled, n_dropped, _joined(chains))


def cells(places: Float, exposure: Int, length: float, detections: int) -> Iterator[Cell]:
    """Cells of the sky with about so many detections, and with any."""
    square = _squares(places, length)
    extent = square.max(axis=1) + 1.0
    side = int(np.sqrt(detections / len(places) * extent[0] * extent[1])) + 1
    side, margin = max(side, MIN_SIDE * FINE), MARGIN * FINE
    n_lines = int(square[1].max()) // side + 3  # none in the first and the last
    cell = (square[0] // side + np.int64(1)) * n_lines + square[1] // side + 1
    order = np.argsort(cell, kind="stable")
    cell, square = cell[order], square[:, order]
    for number in np.unique(cell):
        low = side * (np.array(divmod(int(number), n_lines)) - 1)
        high = low + side
        # the cell and those about it: three in a column follow one another
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
    """Squares (2, N) from the lowest, of a grid that is the same for all cells."""
    lowest, highest = (np.floor(end / (length / FINE)) for end in (places.min(0), places.max(0)))
    narrow = (highest - lowest).max() < np.iinfo(np.int32).max
    square = np.empty((2, len(places)), np.int32 if narrow else np.int64)
    for axis in range(2):
        square[axis] = np.floor(places[:, axis] / (length / FINE)) - lowest[axis]
    return square


def _within(square: Int, low: Int, high: Int) -> Bool:
    """Boolean mask (n,) of squares (2, n) from low (2,) up to high (2,)."""
    (i, j), (a, b), (c, d) = square, low, high
    return np.asarray((i >= a) & (i < c) & (j >= b) & (j < d))


def grouped(cell: Cell) -> Grouped:
    """Groups of a cell."""
    places, rows = cell.places, cell.rows
    column, line = _squares(places, cell.length)
    key = column * (line.max() + np.int64(1)) + line
    _, some, of_square = np.unique(key, return_index=True, return_inverse=True)
    pairs = cKDTree(places[some]).query_pairs(cell.length, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), bool), tuple(pairs.T)), shape=(len(some),) * 2)
    n, group_of_square = connected_components(links, directed=False)
    group = group_of_square[of_square].astype(np.int64)  # codes of groups and exposures multiply
    chain = _spans(places, group, n) > MAX_EXTENT * cell.length
    reaches = np.zeros(n, bool)
    reaches[group[cell.inside]] = True  # the first detection of a chain may be far off
    chained = (chain & reaches)[group]
    heads = np.full(n, len(rows))
    np.minimum.at(heads, group, np.arange(len(rows)))
    own = cell.inside[heads] & ~chain
    second = _seconds(places / cell.length, cell.exposure, group, own)
    kept = own[group]
    kept[second] = False
    stars, which = group[kept], rows[kept]
    # the first that is left
    first = np.full(n, NO_STAR)
    first[stars[::-1]] = which[::-1]
    doubled = len(np.unique(group[second]))
    return Grouped(which, first[stars], doubled, len(second), rows[chained], group[chained])


def _spans(places: Float, group: Int, n: int) -> Float:
    """Larger one of the sides (n,) of the rectangle that holds a group."""
    span = np.zeros(n)
    for axis in range(2):
        low, high = np.full(n, np.inf), np.full(n, -np.inf)
        np.minimum.at(low, group, places[:, axis])
        np.maximum.at(high, group, places[:, axis])
        span = np.maximum(span, high - low)
    return span


def _seconds(places: Float, exposure: Int, group: Int, own: Bool) -> Int:
    """Indices of detections of groups (n,) that are not their exposure's nearest to the mean.

    `places` are in linking lengths.  The mean of two detections is as far from one as from the
    other: rounding does not choose, and the first is taken.
    """
    key = group * (int(exposure.max()) + 1) + exposure
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    several = np.zeros(len(key), bool)
    several[order[1:][same]] = several[order[:-1][same]] = True
    several &= own[group]
    at = np.flatnonzero(several)
    counts = np.bincount(group)
    middle = np.stack([np.bincount(group, places[:, axis]) / counts for axis in (0, 1)], axis=1)
    distance = np.round(np.hypot(*(places[at] - middle[group[at]]).T), EQUAL)
    at = at[np.lexsort((distance, key[at]))]
    return at[1:][key[at][1:] == key[at][:-1]]


def _joined(chains: list[tuple[Int, Int]]) -> int:
    """Number of chains, of which cells see parts that have rows in common."""
    rows = np.unique(np.concatenate([rows for rows, _ in chains]), return_inverse=True)[1]
    sizes = [int(chain.max(initial=-1)) + 1 for _, chain in chains]
    begins = np.cumsum([0, *sizes[:-1]])
    part = np.concatenate([begin + chain for begin, (_, chain) in zip(begins, chains, strict=True)])
    part = np.unique(part, return_inverse=True)[1]
    n = int(part.max(initial=-1)) + 1
    size = n + int(rows.max(initial=-1)) + 1
    links = coo_array((np.ones(len(part), bool), (part, n + rows)), shape=(size, size))
    return int(connected_components(links, directed=False)[0]) if n else 0
