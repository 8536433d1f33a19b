"""Priors from other sources than the detections, which fix free directions.

Commanded offsets and rolls, scales and ties are Gaussian in the parameters, linearised at a
solution; reference stars of known position, with errors and motions, are priors of the stars.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.matching.linear_map import MIN_PAIRS, LinearMap, iterated_map
from bayesdist.errors import InputError
from bayesdist.infer.equations.priors import Prior
from bayesdist.infer.selfcal.problem import Problem, StarPriors
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int

MIN_REFERENCE_STARS = 2  # reference stars that fix position, rotation and scale
MAX_DISTANCE = 5.0  # times the median from the map: not the reference star, but a neighbour
MIN_MEDIAN = 0.01  # pixels: smallest median distance in this limit


def tie(reference: Float, row: Float, value: float, sigma: float) -> Prior:
    """Prior of one measured linear combination of the parameters.

    `reference`: (D,). `row`: (D,). `value`: measured `row @ (theta - reference)`.
    """
    return Prior(reference, np.outer(row, row) / sigma**2, row * value / sigma**2)


def pointing_prior(
    model: DistortionModel,
    theta: Float,
    offsets: Float,
    sigma: Float,
    *,
    group: Int | None = None,
    pixels: Sequence[tuple[int, float, float]] | None = None,
) -> Prior:
    """Prior of commanded offsets: sky positions of the first chip's reference pixel.

    The pointings of a group of exposures have one unknown origin and independent errors.

    `theta` (D,): at which it is linearised. `offsets` (E, 2): along u and v; NaN where there is
    none. `sigma` (E,): error of each on one axis. `group` (E,): exposures with the same guide
    stars; all of them by default. `pixels`: chip number, x and y of some pixels: their mean
    position is pointed, in place of the reference pixel.
    """
    E, first = len(model.exposures), model.chips[0]
    pixels = pixels or [(first.number, *first.reference_pixel)]
    rows, places = np.zeros((E, 2, model.n_params)), np.zeros((E, 2))
    for chip, x, y in pixels:
        at: dict[str, Any] = {"exposure": np.arange(E), "chip": chip}
        if model.time is not None:
            at["epoch"] = np.full(E, model.time.epoch0[0])
        rows += model.jacobian(theta, np.full(E, x), np.full(E, y), **at) / len(pixels)
        places += model.predict(theta, np.full(E, x), np.full(E, y), **at) / len(pixels)
    precision, right = np.zeros((model.n_params,) * 2), np.zeros(model.n_params)
    known = np.isfinite(offsets).all(axis=1)
    group = np.zeros(E, np.int64) if group is None else group
    for one in np.unique(group[known]):
        here = np.flatnonzero(known & (group == one))
        weight = np.diag(sigma[here] ** -2.0)
        mean = weight.sum(axis=1)
        weight -= np.outer(mean, mean) / mean.sum()  # the origin is unknown
        for axis in range(2):
            J = rows[here, axis]
            precision += J.T @ weight @ J
            right += J.T @ weight @ (offsets[here, axis] - places[here, axis])
    return Prior(np.array(theta, float), precision, right)


def frame_prior(
    model: DistortionModel, theta: Float, name: str, values: Float, sigma: float
) -> Prior:
    """Prior on one property of the exposures' frames ('rotation', 'scale').

    Commanded rolls, each with its error, or scales that scatter about one; their common zero point
    stays free.  `values` (E,) are NaN where there is none; the first exposure's is that of
    the polynomials.
    """
    known = np.flatnonzero(np.isfinite(values))
    rows, now = np.zeros((len(known), model.n_params)), np.zeros(len(known))
    for r, e in enumerate(known):
        names = model.free_frame_names(int(e))
        if name in names:
            at = model.frame_slice(int(e)).start + names.index(name)
            rows[r, at], now[r] = 1.0, theta[at]
    weight = (np.eye(len(known)) - 1.0 / len(known)) / sigma**2
    right = rows.T @ weight @ (values[known] - now)
    return Prior(np.array(theta, float), rows.T @ weight @ rows, right)


@dataclass(frozen=True, eq=False)
class ReferenceStars:
    """Catalogue that gives priors to the stars of a problem."""

    catalog: ReferenceCatalog  # with errors, on the plane and in the unit of the solution
    radius: float  # largest distance, in pixels, of a star from its reference star

    def __call__(self, problem: Problem, theta: Float) -> StarPriors:
        """Priors of the stars of a problem at a solution theta (D,).

        The stars are mapped to the catalogue by a linear map first: free directions must not decide
        the identification.  A star that lies far from its reference star, compared with the others,
        has none.

        InputError when hardly a star is found again.
        """
        catalog = self.catalog.at(problem.epoch0) if problem.epoch0 else self.catalog
        places = problem.middles(theta)
        rows, which = self._pairs(problem, catalog, places)
        if len(rows) < MIN_REFERENCE_STARS:
            raise InputError(
                f"{len(rows)} of its {len(catalog)} stars are among the {problem.n_stars} detected "
                f"ones, and {MIN_REFERENCE_STARS} are needed",
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

    def _pairs(self, problem: Problem, catalog: ReferenceCatalog, places: Float) -> tuple[Int, Int]:
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
        if near.sum() > MIN_PAIRS:
            typical = max(float(np.median(distance[near])), MIN_MEDIAN * radius)
            near &= distance <= MAX_DISTANCE * typical
        # of two stars the nearer one
        order = np.flatnonzero(near)[np.argsort(distance[near], kind="stable")]
        _, first = np.unique(nearest[order], return_index=True)
        rows = np.sort(order[first])
        return rows, nearest[rows]
