"""Linear maps of the exposures of one field onto the first exposure, without a catalogue.

Each exposure is recognised by the patterns of its bright stars among the stars of the exposures
that are already mapped. Its remaining stars are then added to these. Exposures that do not overlap
with the first one are thereby connected through others.
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

BRIGHT_STARS = 3000  # number of bright stars of an exposure that are used
WIDE = 0.3  # of the spacing; stars farther than this from all others are new
NARROW = 0.1  # of the spacing; final search radius of the linear map
MAX_COMMON_FRACTION = 0.5  # fraction of equal positions above which two exposures are identical
SCALES = (0.97, 1.03)


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
    """Maps of all exposures onto the first one.

    `planes` (N_e, 2) are the positions in each exposure after the known distortion. With `mags`,
    only bright stars are used. InputError if the exposures form several groups without common
    stars; the message lists the groups.
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
    """Raise InputError if an exposure has two names; `pixels` (N_e, 2) are raw positions."""
    rows = [{tuple(row) for row in np.round(positions, 6).tolist()} for positions in pixels]
    for b in range(len(rows)):
        for a in range(b):
            if len(rows[a] & rows[b]) > MAX_COMMON_FRACTION * min(len(rows[a]), len(rows[b])):
                raise InputError(
                    f"exposures {names[a]} and {names[b]} have the same detections",
                    where=source,
                    do="leave one of them out: it says nothing new",
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
