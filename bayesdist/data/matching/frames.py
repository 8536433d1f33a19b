"""Exposures of one field brought onto the first of them, without a catalogue.

Each exposure is recognised by the patterns of its bright stars among the stars of the exposures
that have been brought on already; its other stars are added to these, so that exposures that do not
reach the first one follow by way of others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from bayesdist.data.matching.linear_map import LinearMap
from bayesdist.data.matching.similarity import (
    PatternIndex,
    find_similarity,
    grown_map,
    pattern_index,
)
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int

BRIGHT_STARS = 3000  # stars of an exposure that are used
WIDE = 0.3  # of the spacing: stars farther from those of others are new
NARROW = 0.1  # of the spacing: last reach of the linear map
MAX_COMMON_FRACTION = 0.5  # fraction of equal positions above which two exposures are one
SCALES = (0.97, 1.03)


@dataclass(frozen=True, eq=False)
class MutualFrames:
    """Linear maps of exposures: position on the first one's plane = matrix @ position + shift."""

    matrices: Float  # (E, 2, 2)
    shifts: Float  # (E, 2)

    @property
    def rotations(self) -> Float:
        """Rotations (E,) of the similarities nearest to the matrices, radians."""
        M = self.matrices
        return np.asarray(np.arctan2(M[:, 1, 0] - M[:, 0, 1], M[:, 0, 0] + M[:, 1, 1]))


def mutual_frames(
    planes: Sequence[Float],
    mags: Sequence[Float] | None,
    names: Sequence[str],
    *,
    source: str = "star lists",
) -> MutualFrames:
    """Maps of all exposures onto the first.

    `planes` (N_e, 2) are the positions of each exposure after the known distortion; with `mags`
    only the bright stars are used.  InputError names the groups of exposures that have no stars in
    common.
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
    found = groups[0]
    E = len(planes)
    matrices, shifts = np.empty((E, 2, 2)), np.empty((E, 2))
    for e, one in found.items():
        matrices[e] = one.matrix
        shifts[e] = one(np.zeros((1, 2)))[0]
    return MutualFrames(matrices, shifts)


def refuse_duplicates(
    pixels: Sequence[Float], names: Sequence[str], *, source: str = "star lists"
) -> None:
    """Refuse an exposure listed twice under two names; `pixels` (N_e, 2) are raw positions."""
    rows = [{tuple(row) for row in np.round(one, 6).tolist()} for one in pixels]
    for b in range(len(rows)):
        for a in range(b):
            if len(rows[a] & rows[b]) > MAX_COMMON_FRACTION * min(len(rows[a]), len(rows[b])):
                raise InputError(
                    f"exposures {names[a]} and {names[b]} have the same detections",
                    where=source,
                    do="leave one of them out: it says nothing new",
                )


def _groups(planes: Sequence[Float], mags: Sequence[Float] | None) -> list[dict[int, LinearMap]]:
    """Groups of exposures that are connected, each with the maps onto the first of its group."""
    bright = [_brightest(planes[e], None if mags is None else mags[e]) for e in range(len(planes))]
    left, out = list(range(len(planes))), list[dict[int, LinearMap]]()
    while left:
        first = left.pop(0)
        found = {first: LinearMap(np.eye(2), np.zeros(2), np.zeros(2))}
        master, magnitude = planes[first][bright[first]], _of(mags, first, bright[first])
        fresh = True
        while fresh and left:
            fresh = False
            index = pattern_index(master, magnitude)
            for e in tuple(left):
                points = planes[e][bright[e]]
                one = _onto(points, _of(mags, e, bright[e]), index)
                if one is None:
                    continue
                left.remove(e)
                found[e] = one
                fresh = True
                moved = one(points)
                distance, _ = cKDTree(master).query(moved)
                new = distance > index.spacing * WIDE
                master = np.concatenate([master, moved[new]])
                if magnitude is not None and mags is not None:
                    magnitude = np.concatenate([magnitude, mags[e][bright[e]][new]])
        out.append(found)
    return out


def _onto(points: Float, mag: Float | None, index: PatternIndex) -> LinearMap | None:
    """Linear map of an exposure; None where it is not recognised."""
    try:
        found = find_similarity(points, index, mag=mag, scale=SCALES)
    except InputError:
        return None
    return grown_map(points, found, index, narrow=NARROW)


def _brightest(plane: Float, mag: Float | None) -> Int:
    if mag is None or len(plane) <= BRIGHT_STARS:
        return np.arange(len(plane))
    return np.sort(np.argsort(mag, kind="stable")[:BRIGHT_STARS])


def _of(mags: Sequence[Float] | None, e: int, rows: Int) -> Float | None:
    return None if mags is None else mags[e][rows]


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(names[:4])
    return f"({shown}{f' and {len(names) - 4} more' if len(names) > 4 else ''})"
