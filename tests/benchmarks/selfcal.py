"""bayesdist on a dithered field: bright stars first, then all, with the reference stars."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bayesdist.data.matching.pairs import LinearMap, best_similarity, iterated_map
from bayesdist.kinds.selfcal.infer import SelfCalibrationMode, self_calibrate
from bayesdist.kinds.selfcal.infer.problem import Problem, StarPriors
from bayesdist.model import DistortionModel
from tests.benchmarks.dithered import (
    BRIGHT,
    REACH,
    REFERENCE_SIGMA,
    DitheredSky,
    relative,
)

__all__ = ["RIGID", "own_solution", "start_of"]

Float = NDArray[np.float64]

RIGID = "shift_rotation"
MATCH = 1.0  # pixels: as far as false detections of a star lie from it
FIRST_MATCH = 2.0
SPACING = 0.3  # of the reference stars' distances: how far the first map may be off


def start_of(sky: DitheredSky, model: DistortionModel) -> Float:
    """Parameters (D,) of no distortion and the commanded pointings."""
    o = np.asarray(model.origin)
    cos, sin = np.cos(sky.rolls[0]), np.sin(sky.rolls[0])
    linear = np.zeros((2, model.n_terms))
    linear[:, 0] = sky.commanded[0]
    linear[:, 1:3] = [[cos, -sin], [sin, cos]]
    coefficients = model.basis().from_monomials(linear)
    theta = np.zeros(model.n_params)
    for axis in (0, 1):
        theta[model.coefficient_slice(None, axis)] = coefficients[axis]
    arm = sky.commanded[0] - o
    for e in range(1, len(model.exposures)):
        angle = sky.rolls[e] - sky.rolls[0]
        cos, sin = np.cos(angle), np.sin(angle)
        shift = sky.commanded[e] - o - np.array([[cos, -sin], [sin, cos]]) @ arm
        values = {"shift_u": shift[0], "shift_v": shift[1], "rotation": angle}
        names = model.free_frame_names(e)
        theta[model.frame_slice(e)] = [values.get(name, 0.0) for name in names]
    return theta


def own_solution(sky: DitheredSky, frames: str) -> dict[str, Any]:
    """Calibrate.

    Parameters
    ----------
    sky : DitheredSky
    frames : str
        What exposures may differ by: 'shift_rotation', or 'affine' as SCAMP lets them.

    Returns
    -------
    dict
        places, shape (E, N, 2), of the grid on the sky; seconds, cpu_s; sigma, shape (N, 2), of
        relative places.
    """
    detections = sky.field.unlabelled
    assert detections.mag is not None
    model = replace(sky.field.model, frames=frames)
    clock, cpu = time.perf_counter(), time.process_time()
    first = self_calibrate(
        model,
        detections.select(detections.mag <= np.quantile(detections.mag, BRIGHT)),
        start_of(sky, model),
        match_radius=FIRST_MATCH,
        start_radius=REACH,
        min_detections=3,
    ).mode
    onto = _onto_references(first, sky.references, rigid=frames == RIGID)

    def known(problem: Problem, *_: object) -> StarPriors:
        return _priors(problem, first.theta, onto, sky.references)

    found = self_calibrate(
        model, detections, first.theta, match_radius=MATCH, min_detections=3, references=known
    ).mode
    seconds, cpu = time.perf_counter() - clock, time.process_time() - cpu
    return {
        "places": onto(sky.places(model, found.theta)),
        "seconds": seconds,
        "cpu_s": cpu,
        "sigma": _sigma(sky, found),
    }


def _onto_references(solution: SelfCalibrationMode, references: Float, *, rigid: bool) -> LinearMap:
    """From the sky of a solution onto the reference stars.

    Where exposures are rigid it is a similarity, under which they stay so.
    """
    stars, tree = solution.stars[:, :2], cKDTree(references)
    spacing = float(np.median(tree.query(references, 2)[0][:, 1]))
    start = LinearMap(np.eye(2), np.zeros(2), stars.mean(axis=0))
    found = iterated_map(stars, references, tree, start, SPACING * spacing, MATCH)
    if found is None:
        raise RuntimeError("the reference stars are not found again")
    if not rigid:
        return found
    distance, which = tree.query(found(stars), distance_upper_bound=MATCH)
    near = np.isfinite(distance)
    return best_similarity(stars[near], references[which[near]])


def _priors(problem: Problem, theta: Float, onto: LinearMap, references: Float) -> StarPriors:
    """What the reference stars say of the stars of a problem, on the sky of the solution."""
    back = np.linalg.inv(onto.matrix)
    known = (references - onto.origin - onto.shift) @ back.T + onto.origin
    distance, rows = cKDTree(problem.middles(theta)).query(known, distance_upper_bound=MATCH)
    near = np.isfinite(distance)
    none = StarPriors.none(problem.n_stars, problem.n_star)
    centre, precision = none.centre.copy(), none.precision.copy()
    centre[rows[near]] = known[near]
    precision[rows[near]] += onto.matrix.T @ onto.matrix / REFERENCE_SIGMA**2
    return replace(none, centre=centre, precision=precision)


def _sigma(sky: DitheredSky, solution: SelfCalibrationMode) -> Float:
    """Errors (N, 2) of relative places of the grid that the solution claims."""
    model = solution.problem.model
    x, y = sky.grid
    J = model.jacobian(solution.theta, x, y, exposure=0)
    moved = relative(np.moveaxis(J, 2, 0), model.predict(solution.theta, x, y, exposure=0))
    return np.sqrt(np.einsum("dna,de,ena->na", moved, solution.cov, moved))
