"""Detections grouped into stars: friends of friends on positions that exposures have in common."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from bayesdist.arrays import Float, Int
from bayesdist.data.detections import NO_STAR

FINE = 16  # cells in a linking length: detections of one cell are friends without a comparison
MAX_EXTENT = 3.0  # linking lengths that a group may span: a longer one is a chain of stars


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


def friends_of_friends(places: Float, exposure: Int, length: float) -> Friends:
    """Groups of detections (N, 2) that are connected by steps no longer than a linking length.

    Distances are exact to a sixteenth of the length: positions are rounded to cells, so that the
    many detections of one star are a few points.  Codes rise with the first detection of the star.
    """
    cell = np.floor(places / (length / FINE)).astype(np.int64)
    cell -= cell.min(axis=0)
    key = cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1]
    _, first, of_cell = np.unique(key, return_index=True, return_inverse=True)
    tree = cKDTree(places[first])
    pairs = tree.query_pairs(length, output_type="ndarray")
    n = len(first)
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    _, group_of_cell = connected_components(graph, directed=False)
    group = group_of_cell[of_cell]
    group, n_chains, broken = _without_chains(places, group, MAX_EXTENT * length)
    star, n_doubled = _one_of_each(places, exposure, group)
    n_dropped = int((star == NO_STAR).sum()) - broken
    good = star != NO_STAR
    # codes in the order of the first detection
    codes, first, code = np.unique(star[good], return_index=True, return_inverse=True)
    rank = np.empty(len(codes), np.int64)
    rank[np.argsort(first)] = np.arange(len(codes))
    out = np.full(len(star), NO_STAR)
    out[good] = rank[code]
    return Friends(out, len(codes), n_doubled, n_dropped, n_chains)


def _without_chains(places: Float, group: Int, most: float) -> tuple[Int, int, int]:
    """Groups (N,) without those that span too much, their number, and that of their detections."""
    n = int(group.max()) + 1
    span = np.zeros(n)
    for axis in range(2):
        low, high = np.full(n, np.inf), np.full(n, -np.inf)
        np.minimum.at(low, group, places[:, axis])
        np.maximum.at(high, group, places[:, axis])
        span = np.maximum(span, high - low)
    chain = span > most
    lost = chain[group]
    return np.where(lost, NO_STAR, group), int(chain.sum()), int(lost.sum())


def _one_of_each(places: Float, exposure: Int, group: Int) -> tuple[Int, int]:
    """Groups (N,) with one detection an exposure, nearest to the mean; number that had several."""
    good = np.flatnonzero(group != NO_STAR)
    if not len(good):
        return group, 0
    n = int(group[good].max()) + 1
    counts = np.maximum(np.bincount(group[good], minlength=n), 1)
    middle = np.stack(
        [np.bincount(group[good], places[good, axis], n) / counts for axis in (0, 1)], axis=1
    )
    distance = np.hypot(*(places[good] - middle[group[good]]).T)
    order = np.lexsort((distance, exposure[good], group[good]))
    rows = good[order]
    again = np.zeros(len(rows), bool)
    again[1:] = (group[rows][1:] == group[rows][:-1]) & (exposure[rows][1:] == exposure[rows][:-1])
    out = group.copy()
    out[rows[again]] = NO_STAR
    return out, len(np.unique(group[rows[again]]))
