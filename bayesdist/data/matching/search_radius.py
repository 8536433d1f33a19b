"""Search radius for pairs, derived from the distances of the pairs.

In regions with a less well known distortion, usually the corners, pairs need a larger search radius
than in the middle. A radius that is large everywhere includes false matches (the WISE distortion
report, Section 3, item 1: criteria that depend on the radial distance from the centre).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bayesdist.utils.arrays import Float

_MIN_PAIRS_IN_RING = 100
_MAX_RINGS = 8
_TRUE_PAIRS_WITHIN = 0.98  # fraction of the true pairs within half the radius
_MARGIN = 2.0
_MIN_RADIUS = 1e-3  # of the largest radius; pairs without scatter still have rounding errors


@dataclass(frozen=True, eq=False)
class SearchRadius:
    """Largest distance of a pair, as a function of the distance from the centre of the detections.

    The radius is interpolated linearly between rings and is constant beyond them.

    Parameters
    ----------
    rho : ndarray, shape (R,)
        Median distance of the pairs in each ring from the centre, ascending.
    radius : ndarray, shape (R,)
        Largest distance of a pair in each ring.
    """

    rho: Float
    radius: Float

    def __call__(self, rho: Float) -> Float:
        """Radius at given distances from the centre."""
        return np.interp(rho, self.rho, self.radius)


def search_radius(
    rho: Float, distance: Float, unpaired: Float, *, largest: float, chance: float
) -> SearchRadius:
    """Radius that keeps nearly all true pairs and few false ones.

    In each ring, the distances of the pairs are a mixture of those of true pairs, which are
    concentrated near zero, and of chance pairs, with a number within r that grows as r^2. The
    radius is twice that within which 98 % of the true pairs are found. For circular normal errors
    it is 5.6 standard errors, and larger for the wider mixture of bright and faint stars.

    Parameters
    ----------
    rho : ndarray, shape (n,)
        Distances of the pairs from the centre.
    distance : ndarray, shape (n,)
        Distances between the two members of a pair, up to `largest`.
    unpaired : ndarray, shape (m,)
        Distances of the unpaired detections from the centre.
    largest : float
        Radius within which the pairs were searched for.
    chance : float
        Probability that a detection without true counterpart finds a neighbour within that radius.

    Returns
    -------
    SearchRadius
        Search radius, at most `largest`.
    """
    rings = int(np.clip(len(rho) // _MIN_PAIRS_IN_RING, 1, _MAX_RINGS))
    order = np.argsort(rho, kind="stable")
    edges = np.concatenate(
        [[-np.inf], [rho[part[0]] for part in np.array_split(order, rings)[1:]], [np.inf]]
    )
    middles, radii = [], []
    for low, high in pairwise(edges):
        inside = (rho >= low) & (rho < high)
        distances = np.sort(distance[inside])
        if not len(distances):  # an empty ring, if distances from the centre are equal
            continue
        all_detections = len(distances) + int(((unpaired >= low) & (unpaired < high)).sum())
        # n = true + chance (all - true)
        true = max(
            (len(distances) - chance * all_detections) / (1.0 - chance), 0.5 * len(distances)
        )
        false = len(distances) - true
        excess = np.arange(1, len(distances) + 1) - false * (distances / largest) ** 2
        within = distances[int(np.argmax(excess >= _TRUE_PAIRS_WITHIN * true))]
        middles.append(float(np.median(rho[inside])))
        radii.append(float(np.clip(_MARGIN * within, _MIN_RADIUS * largest, largest)))
    return SearchRadius(np.array(middles), np.array(radii))
