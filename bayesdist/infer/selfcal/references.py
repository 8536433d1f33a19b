"""Reference stars: stars of known position, with errors and motions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.matching.linear_map import MIN_PAIRS, LinearMap, iterated_map
from bayesdist.errors import InputError
from bayesdist.infer.selfcal.problem import Problem, StarPriors

__all__ = ["ReferenceStars"]

Float = NDArray[np.float64]

FEWEST = 2  # reference stars that fix position, rotation and scale
FAR = 5.0  # times the median distance from the map: not the reference star, but a neighbour
CLOSE = 0.01  # pixels: smallest median distance in this limit


@dataclass(frozen=True, eq=False)
class ReferenceStars:
    """Catalogue that gives priors to the stars of a problem.

    Parameters
    ----------
    catalog : ReferenceCatalog
        With errors, on the plane and in the unit of the solution.
    radius : float
        Largest distance, in pixels, of a star from its reference star.
    """

    catalog: ReferenceCatalog
    radius: float

    def __call__(self, problem: Problem, theta: Float) -> StarPriors:
        """Priors of the stars of a problem at a solution theta (D,).

        The stars are mapped to the catalogue by a linear map first: free directions must not decide
        the identification.  A star that lies far from its reference star, compared with the others,
        has none.

        Raises
        ------
        InputError
            When hardly a star is found again.
        """
        catalog = self.catalog.at(problem.epoch0) if problem.epoch0 else self.catalog
        places = problem.middles(theta)
        rows, which = self._pairs(problem, catalog, places)
        if len(rows) < FEWEST:
            raise InputError(
                f"{len(rows)} of its {len(catalog)} stars are among the {problem.n_stars} detected "
                f"ones, and {FEWEST} are needed",
                where=catalog.source,
                do="check epoch, tangent point and unit, or give a larger gauge.reference.radius",
            )
        none = StarPriors.none(problem.n_stars, problem.n_star)
        centre, precision = none.centre.copy(), none.precision.copy()
        moving = problem.n_star >= 4 and catalog.pm_u is not None and catalog.sigma_pm_u is not None
        for axis, name in enumerate("uv"):
            sigma = getattr(catalog, f"sigma_{name}")[which]
            centre[rows, axis] = getattr(catalog, name)[which]
            if not moving:
                precision[rows, axis, axis] += sigma**-2.0
                continue
            # at its own epoch a catalogue's positions and motions are independent; here, years
            # later, a position is the one plus years times the other
            sigma = getattr(self.catalog, f"sigma_{name}")[which]
            motion = getattr(self.catalog, f"sigma_pm_{name}")[which]
            years = (
                problem.epoch0
                - np.broadcast_to(np.asarray(self.catalog.epoch, float), len(self.catalog))[which]
            )
            centre[rows, 2 + axis] = getattr(catalog, f"pm_{name}")[which]
            precision[rows, axis, axis] += sigma**-2.0
            precision[rows, axis, 2 + axis] -= years * sigma**-2.0
            precision[rows, 2 + axis, axis] -= years * sigma**-2.0
            precision[rows, 2 + axis, 2 + axis] += motion**-2.0 + (years / sigma) ** 2
        return replace(none, centre=centre, precision=precision)

    def _pairs(
        self, problem: Problem, catalog: ReferenceCatalog, places: Float
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Numbers of stars and of their reference stars."""
        radius = self.radius * problem.pixel
        known = np.column_stack([catalog.u, catalog.v])
        middle = places.mean(axis=0)
        start = LinearMap(np.eye(2), np.zeros(2), middle)
        tree = cKDTree(known)
        laid = iterated_map(places, known, tree, start, radius, radius) or start
        moved = laid(places)
        distance, nearest = tree.query(moved, distance_upper_bound=radius)
        near = np.isfinite(distance)
        limit = FAR * max(float(np.median(distance[near])), CLOSE * radius) if near.any() else 0.0
        if near.sum() > MIN_PAIRS:
            near &= distance <= limit
        # of two stars the nearer one
        order = np.flatnonzero(near)[np.argsort(distance[near], kind="stable")]
        _, first = np.unique(nearest[order], return_index=True)
        rows = np.sort(order[first])
        return rows, nearest[rows]
