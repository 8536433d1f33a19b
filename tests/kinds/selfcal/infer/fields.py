"""Small dithered fields that the tests of self-calibration share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayesdist.kinds.selfcal.infer.problem import prepare
from bayesdist.kinds.selfcal.patterns.exposures import dither_pattern
from bayesdist.model import Chip, DistortionModel
from tests.kinds.selfcal.dithered_fields import simulate_dithers, smooth_distortion

SIZE = (1024.0, 1024.0)


def chips(n: int = 1) -> tuple[Chip, ...]:
    return tuple(Chip(k + 1, f"C{k + 1}", SIZE, (512.0, 512.0)) for k in range(n))


def field(seed, n_exposures=8, n_stars=400, *, order=3, n_chips=1, rolls=(0, 60, 130), **more):
    """A simulated field; its errors go from 0.01 to 0.05 pixels unless said otherwise."""
    rng = np.random.default_rng(seed)
    parts = chips(n_chips)
    offsets, angles = dither_pattern(n_exposures, SIZE, rolls, rng)
    coefficients = smooth_distortion(order, parts, 3.0, rng)
    more = {"sigma": (0.01, 0.05)} | more
    return simulate_dithers(parts, coefficients, offsets, angles, n_stars=n_stars, rng=rng, **more)


def problem_of(simulated, model: DistortionModel | None = None, **more):
    """Its problem with the true stars, linearised at the truth."""
    model = model or simulated.model
    found = prepare(model, simulated.detections, simulated.theta, match_radius=1.0, **more)
    stars = found.mean_places(simulated.theta)
    for _ in range(3):
        found = found.at(simulated.theta, stars)
    return found, stars


def with_ellipses(simulated, seed: int, *, rho: float | None = None):
    """A field simulated without errors, with errors of all shapes, or all correlated by `rho`."""
    rng = np.random.default_rng([46, seed])
    d = simulated.detections
    n = len(d)
    sigma = 0.02 * np.exp(0.4 * rng.standard_normal((2, n)))
    correlation = rng.uniform(-0.95, 0.95, n) if rho is None else np.full(n, rho)
    detections = replace(d, sigma=None, sigma_x=sigma[0], sigma_y=sigma[1], rho_xy=correlation)
    noise = np.linalg.cholesky(detections.covariances) @ rng.standard_normal((n, 2, 1))
    x, y = np.stack([d.x, d.y]) + noise[:, :, 0].T
    return replace(simulated, detections=replace(detections, x=x, y=y))


def aligned(theta, truth, gauge):
    """Parameters moved along the free directions to where the truth has those that are held."""
    null, held = gauge.null, gauge.held
    return theta - null @ np.linalg.solve(null[held], (theta - truth)[held])
