"""Largest distance of a detection from its reference star, found from the distances themselves.

Where a distortion is known less well, usually in the corners, pairs need a larger search radius
than in the middle; a radius that is large everywhere takes in false matches (the WISE distortion
report, Section 3, item 1: criteria that depend on the radial distance from the centre).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bayesdist.utils.arrays import Float

_MIN_PAIRS_IN_RING = 100
_MAX_RINGS = 8
_TRUE_PAIRS_WITHIN = 0.98  # of the true pairs, within half the radius
_MARGIN = 2.0
_MIN_RADIUS = 1e-3  # of the largest radius: pairs without any scatter still have rounding errors


@dataclass(frozen=True, eq=False)
class SearchRadius:
    """Largest distance of a pair, by the distance from the centre of the detections.

    It is linear between the middles `rho` (R,) of rings, rising, and constant beyond.
    """

    rho: Float
    radius: Float

    def __call__(self, rho: Float) -> Float:
        """Radius at distances from the centre."""
        return np.interp(rho, self.rho, self.radius)


def search_radius(
    rho: Float, distance: Float, unpaired: Float, *, largest: float, chance: float
) -> SearchRadius:
    """Radius that keeps nearly all true pairs and few false ones.

    In each ring the distances of the pairs are those of true ones, which crowd near zero, and of
    chance ones, whose number within r grows as r^2.  The radius is twice that within which 98 % of
    the true ones lie: for circular normal errors 5.6 standard errors, for the wider mixture of
    bright and faint stars as much as it needs.

    Parameters
    ----------
    rho : ndarray, shape (n,)
        Distances of the pairs from the centre.
    distance : ndarray, shape (n,)
        Between the two of a pair, up to `largest`.
    unpaired : ndarray, shape (m,)
        Distances from the centre of the detections without pair.
    largest : float
        Radius within which the pairs were looked for.
    chance : float
        Probability of a detection without true counterpart to find a neighbour within it.

    Returns
    -------
    SearchRadius
        At most `largest`.
    """
    rings = int(np.clip(len(rho) // _MIN_PAIRS_IN_RING, 1, _MAX_RINGS))
    order = np.argsort(rho, kind="stable")
    edges = np.concatenate(
        [[-np.inf], [rho[part[0]] for part in np.array_split(order, rings)[1:]], [np.inf]]
    )
    middles, radii = [], []
    for low, high in pairwise(edges):
        inside = (rho >= low) & (rho < high)
        found = np.sort(distance[inside])
        if not len(found):  # rings of equal distances, as on a circle
            continue
        all_detections = len(found) + int(((unpaired >= low) & (unpaired < high)).sum())
        # n = true + chance (all - true)
        true = max((len(found) - chance * all_detections) / (1.0 - chance), 0.5 * len(found))
        false = len(found) - true
        excess = np.arange(1, len(found) + 1) - false * (found / largest) ** 2
        within = found[int(np.argmax(excess >= _TRUE_PAIRS_WITHIN * true))]
        middles.append(float(np.median(rho[inside])))
        radii.append(float(np.clip(_MARGIN * within, _MIN_RADIUS * largest, largest)))
    return SearchRadius(np.array(middles), np.array(radii))
