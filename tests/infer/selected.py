"""Stars that were matched only within a circle about a nominal solution, which is off."""

from __future__ import annotations

import numpy as np

from bayesdist.data import Matches
from bayesdist.model import Chip, DistortionModel

SIDE = 2048.0
SIGMA = 0.02  # pixels
OFF = 0.08  # largest error of the nominal solution
FALSE = 0.04  # of the matches in the circle


def selected(
    seed: int, cut: float, n: int = 1500, *, order: int = 3
) -> tuple[DistortionModel, np.ndarray, Matches, float]:
    """Model, truth, matches, and the radius of their circles: so many sigma.

    The nominal solution differs from the truth by a polynomial of the model's order.  Detections
    are drawn until there are enough in their circles; false ones replace some, evenly over these.
    """
    rng = np.random.default_rng([31, seed])
    model = DistortionModel(order, (Chip(1, "chip", (SIDE, SIDE), (1024.5, 1024.5)),))
    theta = rng.normal(size=model.n_params)
    for axis, term in ((0, (1, 0)), (1, (0, 1))):
        theta[model.coefficient_slice(1, axis)][model.basis().terms.index(term)] += SIDE / 2
    error = (rng.normal(size=(2, model.n_terms)) / (1 + np.arange(model.n_terms))).ravel()
    axis = np.linspace(1, SIDE, 21)
    there = model.predict(error, *(z.ravel() for z in np.meshgrid(axis, axis)))
    nominal = theta + error * OFF / np.hypot(*there.T).max()
    radius, rows = cut * SIGMA, np.zeros((0, 6))
    while len(rows) < n:
        x, y = rng.uniform(0.5, SIDE + 0.5, (2, 4 * n))
        about = model.predict(nominal, x, y)
        seen = model.predict(theta, x, y) + SIGMA * rng.normal(size=(4 * n, 2))
        inside = np.hypot(*(seen - about).T) <= radius
        rows = np.concatenate([rows, np.column_stack([x, y, seen, about])[inside]])
    rows = rows[:n]
    false = rng.uniform(size=n) < FALSE
    distance, angle = radius * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
    spread = distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    rows[false, 2:4] = (rows[:, 4:] + spread)[false]
    x, y, u, v, u_nominal, v_nominal = rows.T
    sigma = np.full(n, SIGMA)
    matches = Matches(
        *(x, y, u, v),
        sigma_u=sigma,
        sigma_v=sigma,
        u_nominal=u_nominal,
        v_nominal=v_nominal,
    )
    return model, theta, matches, radius
