"""What is known before the detections: priors that constrain free directions, and a start.

Commanded offsets, roll angles, scales and ties are Gaussian priors on the parameters, linearised at
a solution.  Reference stars with known positions, errors and proper motions are priors on the
stars.  The starting parameters are an approximate distortion and exposure frames; they are accurate
enough if the detections of a star are within the first linking length of each other on the sky.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.matching.pairs import MIN_PAIRS, LinearMap, iterated_map
from bayesdist.data.sky import parallax_factors
from bayesdist.errors import InputError
from bayesdist.infer.equations.priors import Prior
from bayesdist.kinds.selfcal.grouping import MutualFrames
from bayesdist.kinds.selfcal.infer.problem import Problem, StarPriors
from bayesdist.model import Chip, DistortionModel, PolynomialBasis
from bayesdist.utils.arrays import Float, Int

if TYPE_CHECKING:
    from bayesdist.kinds.star_lists import Start

MIN_REFERENCE_STARS = 2  # minimum number that determines position, rotation and scale
MAX_DISTANCE = 5.0  # limit on the distance of a reference star in medians, to exclude neighbours
MIN_MEDIAN = 0.01  # smallest median used for this limit, as a fraction of the search radius


def tie(reference: Float, row: Float, value: float, sigma: float) -> Prior:
    """Prior from a measurement of a linear combination of the parameters.

    Parameters
    ----------
    reference : ndarray, shape (D,)
        Parameters about which the prior is expanded.
    row : ndarray, shape (D,)
        Coefficients of the linear combination.
    value : float
        Measured value of ``row @ (theta - reference)``.
    sigma : float
        Standard error of the measurement.

    Returns
    -------
    Prior
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
    """Prior from commanded offsets of the pointing.

    The pointings of a group of exposures have a common unknown origin and independent errors.

    Parameters
    ----------
    model : DistortionModel
    theta : ndarray, shape (D,)
        Parameters at which the prior is linearised.
    offsets : ndarray, shape (E, 2)
        Commanded positions of the reference pixel of the first chip along u and v, relative to the
        origin of the group; NaN if unknown.
    sigma : ndarray, shape (E,)
        Standard error of each offset per axis, in the unit of u, v.
    group : ndarray of int, shape (E,), optional
        Group of each exposure, such as exposures with the same guide stars; by default a single
        group.
    pixels : sequence of (int, float, float), optional
        Chip numbers, x and y of pixels. The offsets then refer to the mean position of these
        pixels instead of the reference pixel of the first chip.

    Returns
    -------
    Prior
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
    available = np.isfinite(offsets).all(axis=1)
    group = np.zeros(E, np.int64) if group is None else group
    for number in np.unique(group[available]):
        members = np.flatnonzero(available & (group == number))
        weight = np.diag(sigma[members] ** -2.0)
        mean = weight.sum(axis=1)
        weight -= np.outer(mean, mean) / mean.sum()  # eliminates the unknown origin
        for axis in range(2):
            J = rows[members, axis]
            precision += J.T @ weight @ J
            right += J.T @ weight @ (offsets[members, axis] - places[members, axis])
    return Prior(np.array(theta, float), precision, right)


def frame_prior(
    model: DistortionModel, theta: Float, name: str, values: Float, sigma: float
) -> Prior:
    """Prior on a frame parameter ('rotation', 'scale') of the exposures, up to a common offset.

    It describes commanded roll angles with errors `sigma`, or scales that scatter by `sigma`.
    `values` (E,) are NaN if unknown; that of the first exposure refers to the polynomials.  The
    prior is linearised at theta (D,).
    """
    available = np.flatnonzero(np.isfinite(values))
    rows, now = np.zeros((len(available), model.n_params)), np.zeros(len(available))
    for r, e in enumerate(available):
        names = model.free_frame_names(int(e))
        if name in names:
            at = model.frame_slice(int(e)).start + names.index(name)
            rows[r, at], now[r] = 1.0, theta[at]
    weight = (np.eye(len(available)) - 1.0 / len(available)) / sigma**2
    right = rows.T @ weight @ (values[available] - now)
    return Prior(np.array(theta, float), rows.T @ weight @ rows, right)


@dataclass(frozen=True, eq=False)
class ReferenceStars:
    """Priors on the positions of stars from a reference catalogue.

    Parameters
    ----------
    catalog : ReferenceCatalog
        Reference stars with errors, on the tangent plane and in the unit of the solution.
    radius : float
        Largest distance in pixels between a star and its reference star.
    """

    catalog: ReferenceCatalog
    radius: float

    def __call__(self, problem: Problem, theta: Float) -> StarPriors:
        """Identify the stars of a problem in the catalogue and return their priors.

        The stars are first mapped to the catalogue by a linear map, so that free directions do not
        affect the identification.  Stars that are much farther from their reference star than most
        others get no prior.

        Parameters
        ----------
        problem : Problem
        theta : ndarray, shape (D,)
            Parameters of the current solution.

        Returns
        -------
        StarPriors

        Raises
        ------
        InputError
            If fewer than two stars are identified.
        """
        catalog, dates = self.catalog, problem.dates
        if dates is not None:
            catalog = catalog.at(float(np.mean(dates)))
        places = problem.middles(theta)
        rows, matched = self._pairs(problem, catalog, places)
        if len(rows) < MIN_REFERENCE_STARS:
            raise InputError(
                f"{len(rows)} of its {len(catalog)} stars are among the {problem.n_stars} detected "
                f"ones, but {MIN_REFERENCE_STARS} are needed",
                where=catalog.source,
                do="check epoch, tangent point and unit, or give a larger gauge.reference.radius",
            )
        none = StarPriors.none(problem.n_stars, problem.n_star)
        centre, precision = none.centre.copy(), none.precision.copy()
        values, carry, known = self._carried(problem, rows, matched)
        covariances = self.catalog.covariances[matched]
        for n in np.unique(known).tolist():
            at = known == n
            J, stars = carry[at, :n], rows[at]
            centre[stars, :n] = np.einsum("nij,nj->ni", J, values[at])
            precision[stars, :n, :n] += np.linalg.inv(J @ covariances[at] @ np.swapaxes(J, 1, 2))
        return replace(none, centre=centre, precision=precision)

    def _carried(self, problem: Problem, rows: Int, matched: Int) -> tuple[Float, Float, Int]:
        """Parameters of the catalogue, and their derivatives for those of the stars.

        The first are u, v, parallax, pm_u and pm_v (n, 5) of the catalogue's stars `matched`.  The
        second (n, k, 5) are the derivatives, with respect to them, of the first k parameters of the
        problem's stars `rows`: of the position, of the motion if it is fitted and the catalogue has
        motions with errors, and of the parallax likewise.  The third (n,) is the number of these
        parameters that the catalogue has for each star: its parallax is unknown if its error is 0.
        Stars without a fitted motion or parallax are where they are on average over their
        detections.
        """
        catalog, dates = self.catalog, problem.dates
        columns = (catalog.u, catalog.v, catalog.parallax, catalog.pm_u, catalog.pm_v)
        values = np.zeros((len(matched), len(columns)))
        for k, column in enumerate(columns):
            if column is not None:
                values[:, k] = column[matched]
        known = np.full(len(matched), 2)
        if problem.n_star >= 4 and catalog.pm_u is not None and catalog.sigma_pm_u is not None:
            known[:] = 4
            sigma = catalog.sigma_parallax
            if problem.n_star == 5 and catalog.parallax is not None and sigma is not None:
                known[sigma[matched] > 0] = 5
        n = int(known.max(initial=2))
        carry = np.zeros((len(matched), n, len(columns)))
        carry[:, :2, :2] = np.eye(2)
        if n >= 4:
            carry[:, 2:4, 3:] = np.eye(2)
        if n == 5:
            carry[:, 4, 2] = 1.0
        if dates is None:
            return values, carry, known
        mean = np.add.reduceat(dates, problem.starts[:-1]) / problem.counts
        when = np.full(len(rows), problem.epoch0) if problem.n_star >= 4 else mean[rows]
        if catalog.pm_u is not None and catalog.epoch is not None:
            years = when - np.broadcast_to(np.asarray(catalog.epoch, float), len(catalog))[matched]
            carry[:, :2, 3:] = years[:, None, None] * np.eye(2)
        if (
            problem.n_star < 5
            and catalog.parallax is not None
            and catalog.tangent_point is not None
        ):
            each, of_detection = np.unique(dates, return_inverse=True)
            factors = parallax_factors(each, *catalog.tangent_point)[of_detection]
            sums = np.add.reduceat(factors, problem.starts[:-1], axis=0)
            carry[:, :2, 2] = (sums / problem.counts[:, None])[rows]
        return values, carry, known

    def _pairs(self, problem: Problem, catalog: ReferenceCatalog, places: Float) -> tuple[Int, Int]:
        """Indices of the identified stars, and of their reference stars."""
        radius = self.radius * problem.pixel
        reference = np.column_stack([catalog.u, catalog.v])
        middle = places.mean(axis=0)
        start = LinearMap(np.eye(2), np.zeros(2), middle)
        tree = cKDTree(reference)
        laid = iterated_map(places, reference, tree, start, radius, radius) or start
        moved = laid(places)
        distance, nearest = tree.query(moved, distance_upper_bound=radius)
        near = np.isfinite(distance)
        if near.sum() > MIN_PAIRS:
            typical = max(float(np.median(distance[near])), MIN_MEDIAN * radius)
            near &= distance <= MAX_DISTANCE * typical
        # if two stars match the same reference star, keep the nearer one
        order = np.flatnonzero(near)[np.argsort(distance[near], kind="stable")]
        _, first = np.unique(nearest[order], return_index=True)
        rows = np.sort(order[first])
        return rows, nearest[rows]


# -- starting parameters of a self-calibration: an approximate distortion, and exposure frames -----


def undistorted(chips: Sequence[Chip], pixel: float) -> Start:
    """Start without distortion: positions are pixel offsets from the chip's reference pixel.

    Returns a function of x, y (N,) and a chip number that returns positions (N, 2).  `pixel` is the
    size of a pixel in the unit of u, v.
    """
    reference = {chip.number: chip.reference_pixel for chip in chips}

    def start(x: Float, y: Float, chip: int) -> Float:
        return pixel * (np.stack([x, y], axis=-1) - reference[chip])

    return start


def chips_side_by_side(
    start: Start, chips: Sequence[Chip], frames: MutualFrames, exposure: Int, number: Int
) -> Start:
    """Start with relative positions of the chips that were derived from their stars.

    `start` is the start of each chip by itself.  `frames` are the frames of lists of detections,
    each of one chip in one exposure; `exposure` and `number` (lists,) are the exposure and the chip
    number of each list.  Positions are on the plane of the first chip.  A chip that is never
    observed together with the first chip is unchanged.
    """
    maps = {}
    for chip in chips[1:]:
        relative = []
        for code in np.unique(exposure):
            rows = [
                np.flatnonzero((exposure == code) & (number == n))
                for n in (chips[0].number, chip.number)
            ]
            if all(len(r) for r in rows):
                (a,), (b,) = rows
                back = np.linalg.inv(frames.matrices[a])
                matrix = back @ frames.matrices[b]
                relative.append(
                    np.column_stack([matrix, back @ (frames.shifts[b] - frames.shifts[a])])
                )
        if relative:
            maps[chip.number] = np.median(relative, axis=0)

    def moved(x: Float, y: Float, chip: int) -> Float:
        plane = start(x, y, chip)
        if chip not in maps:
            return plane
        return plane @ maps[chip][:, :2].T + maps[chip][:, 2]

    return moved


def fitted_polynomials(
    start: Start, chips: Sequence[Chip], order: int, onto: LinearMap | None = None
) -> Float:
    """Legendre coefficients (chips, 2, K) that approximate a start, by quadrature over each chip.

    `start` is a function of x, y and a chip number that returns positions (N, 2).  If the map
    `onto` is given, it is applied to these positions.
    """
    out = []
    for chip in chips:
        x, y, weight = chip.quadrature(4 * (order + 1))
        root = np.sqrt(weight)[:, None]
        basis = PolynomialBasis(order, chip.size, chip.reference_pixel).evaluate(x, y)
        plane = start(x, y, chip.number)
        plane = plane if onto is None else onto(plane)
        out.append(np.linalg.lstsq(root * basis, root * plane, rcond=None)[0].T)
    return np.stack(out)


def start_parameters(
    model: DistortionModel, coefficients: Float, frames: MutualFrames, middles: Float
) -> Float:
    """Parameters (D,) from polynomials and the frames of the exposures relative to the first one.

    `coefficients` (chips, 2, K) are those of the polynomials.  Frames of the model may be simpler
    than the given ones; they agree at `middles` (E, 2), the centre of the detections of each
    exposure on the plane of that exposure.
    """
    theta = np.zeros(model.n_params)
    for chip, of_chip in zip(model.chips, coefficients, strict=True):
        for axis in (0, 1):
            theta[model.coefficient_slice(chip.number, axis)] = of_chip[axis]
    o = np.asarray(model.origin)
    for e in range(1, len(model.exposures)):
        names = model.free_frame_names(e)
        angle = frames.rotations[e] if "rotation" in names else 0.0
        c, s = np.cos(angle), np.sin(angle)
        place = frames.matrices[e] @ middles[e] + frames.shifts[e]
        shift = place - o - np.array([[c, -s], [s, c]]) @ (middles[e] - o)
        values = {"shift_u": shift[0], "shift_v": shift[1], "rotation": angle}
        theta[model.frame_slice(e)] = [values.get(name, 0.0) for name in names]
    return theta
