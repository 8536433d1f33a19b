"""Errors of self-calibrations, whose sky is known up to what detections alone leave open."""

from __future__ import annotations

import numpy as np
from astropy.table import Table
from numpy.polynomial import legendre

from bayesdist.app.run import Run
from bayesdist.model.grid import grid_pixels, mesh

from .fields import MIDDLE, SIDE
from .truth import Truth

COLUMNS = ("x", "y", "mag", "exposure")  # of the lists: what an observer has
NODES = 24  # on each axis, of integrals over the detector


def lists_of(truth: Truth) -> Table:
    """Detections as an observer has them."""
    return Table({name: truth.stars[name] for name in COLUMNS})


def aligned(run: Run, truth: Truth) -> np.ndarray:
    """Shift, rotation and scale (4,) of the true sky by which held parameters have no errors.

    As z -> (p + i q) z + (r + i s), of the positions z = u + i v.
    """
    solution, gauge = run.solution, run.parts["solved"].gauge
    model, mean = solution.model, np.asarray(solution.mean)
    assert gauge.open.shape[1] == 4, "the exposures leave more free than a similarity"
    nodes, weights = legendre.leggauss(NODES)
    X, Y = (a.ravel() for a in np.meshgrid(nodes, nodes))
    weight = np.outer(weights, weights).ravel()
    x, y = MIDDLE + X * SIDE / 2, MIDDLE + Y * SIDE / 2
    basis = model.basis(model.chips[0].number)
    phi = basis.evaluate_scaled(X, Y)
    onto = np.linalg.solve(phi.T @ (weight[:, None] * phi), phi.T * weight)
    u, v = truth.true_map(x, y, None).T
    # what each of the four makes of u and v
    moves = ((u, v), (-v, u), (np.ones_like(u), 0 * u), (0 * u, np.ones_like(u)))
    design = np.array([np.concatenate([onto @ a, onto @ b]) for a, b in moves]).T
    held = gauge.held
    return np.linalg.solve(design[held], mean[held])


def moved(uv: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Positions (N, 2) under a similarity (4,)."""
    p, q, r, s = by
    u, v = uv.T
    return np.stack([p * u - q * v + r, q * u + p * v + s], axis=1)


def selfcal_error(run: Run, truth: Truth, seen: np.ndarray, code: int) -> np.ndarray:
    """Predicted less true positions (ny * nx, 2) over the grid, in the gauge of the run.

    Of positions `seen` in the exposure of that code, along the axes of the polynomials.
    """
    solution = run.solution
    model, mean = solution.model, np.asarray(solution.mean)
    x, y = mesh(*grid_pixels(model.chips[0].size, run.config.assess.grid))
    frame = truth.frames[model.exposures[code]]
    true = moved(frame.seen(truth.true_map(x, y, None)), aligned(run, truth))
    return np.linalg.solve(model.frame(mean, code)[0], (seen - true).T).T
