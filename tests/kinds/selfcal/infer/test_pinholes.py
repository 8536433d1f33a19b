"""A mask of pinholes that is moved by known steps: a self-calibration with known offsets."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from bayesdist.kinds.selfcal.infer import pointing_prior
from bayesdist.kinds.selfcal.infer.mode import solve_in_gauge
from tests.kinds.selfcal.infer.fields import field, problem_of

STEPS = 0.002  # pixels, by which the stage is known


def test_order_ten_by_a_mask_whose_holes_are_not_known():
    """Twelve positions of 600 holes at two angles: every coefficient, scale and angle included."""
    simulated = field(7, 12, 600, order=10, rolls=(0, 90), sigma=0.005)
    model, theta = simulated.model, simulated.theta
    assert model.n_polynomial == 132
    x, y = (np.full(12, c) for c in model.chips[0].reference_pixel)
    rng = np.random.default_rng(8)
    true = model.predict(theta, x, y, exposure=np.arange(12))
    commanded = true + STEPS * rng.standard_normal(true.shape)
    problem, holes = problem_of(simulated)
    mode = solve_in_gauge(
        problem,
        theta,
        lambda at: pointing_prior(model, at, commanded, np.full(12, STEPS)),
        stars=holes,
        jitter=0.0,
    )
    found = mode.solution
    held = {model.names[k] for k in np.flatnonzero(found.sigma == 0)}
    assert held == {"u_0_0", "v_0_0"}  # where the mask is, nobody knows
    free = np.flatnonzero(found.sigma[: model.n_polynomial] > 0)
    off = (found.mean - theta)[free]
    square = off @ np.linalg.solve(found.cov[np.ix_(free, free)], off)
    assert 1e-3 < chi2.sf(square, free.size) < 1 - 1e-3
    assert np.abs(off / found.sigma[free]).max() < 4.5
