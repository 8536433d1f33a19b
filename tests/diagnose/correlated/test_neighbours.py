"""Products of neighbouring stars' scores: nothing of independent errors, the size of a pattern."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from bayesdist.diagnose.correlated import estimate_discrepancy
from bayesdist.diagnose.correlated.neighbours import EDGES, shared_variances
from bayesdist.infer import fit_linear
from bayesdist.infer.solution.solution import likelihood_of
from bayesdist.model import Chip, DistortionModel
from bayesdist.simulate import simulate_matches

SIDE, SIGMA, N = 1024, 0.02, 2500


@pytest.fixture(scope="module")
def model() -> DistortionModel:
    return DistortionModel(2, (Chip(1, "A", (SIDE, SIDE), (SIDE / 2, SIDE / 2)),))


def stripes(x: np.ndarray, size: float, period: float) -> np.ndarray:
    return size * np.where(x % period < period / 2, 1.0, -1.0)


def fitted(model: DistortionModel, seed: int, size: float = 0.0, period: float = 60.0):
    """Matches with stripes along u, and their fit."""
    theta = np.zeros(model.n_params)
    for axis in (0, 1):
        theta[model.coefficient_slice(1, axis)][[0, 1 + axis]] = SIDE / 2
    rng = np.random.default_rng(seed)
    matches, _ = simulate_matches(model, theta, N, rng=rng, sigma=SIGMA)
    u = matches.u + stripes(matches.x, size, period)
    matches = type(matches)(**{**vars(matches), "u": u})
    return matches, fit_linear(matches, model)


def test_stars_that_err_independently_have_nothing_in_common(model):
    pulls = []
    for seed in range(12):
        matches, fit = fitted(model, seed)
        for one in shared_variances(matches, likelihood_of(fit), model)[0]:
            pulls.append(one.covariance / np.sqrt(one.variance))
    assert abs(np.mean(pulls)) < 3 / np.sqrt(np.size(pulls) / 2)  # bins share the pairs farther off
    assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1, abs=0.25)


def test_stripes_have_their_covariance_by_separation(model):
    size, period = 0.02, 60.0
    matches, fit = fitted(model, 1, size, period)
    u, v = shared_variances(matches, likelihood_of(fit), model)[0]
    assert np.all(np.abs(v.covariance) < 4 * np.sqrt(v.variance))
    # a star and another one at that distance in any direction, by drawing them
    rng = np.random.default_rng(0)
    x, angle = rng.uniform(0, period, 200_000), rng.uniform(0, 2 * np.pi, 200_000)
    at = []
    for low, high in pairwise(EDGES):
        along = np.sqrt(rng.uniform(low**2, high**2, x.size)) * np.cos(angle)
        at.append(np.mean(stripes(x, size, period) * stripes(x + along, size, period)))
    left = u.covariance - (np.array(at[:-1]) - at[-1])
    assert np.all(np.abs(left) < 4 * np.sqrt(u.variance))
    assert u.covariance[0] > 4 * np.sqrt(u.variance[0])


def test_matches_of_one_star_are_no_neighbours(model):
    matches, fit = fitted(model, 2)
    same = type(matches)(**{**vars(matches), "star": np.zeros(len(matches), np.int64)})
    assert shared_variances(same, likelihood_of(fit), model)[0] == (None, None)


@pytest.mark.parametrize("size", [0.0, 0.02])
def test_stripes_along_one_axis_are_measured_on_that_axis(model, size):
    """And none where there are none: the prior's tail, far below the errors of the stars."""
    matches, fit = fitted(model, 3, size)
    rng = np.random.default_rng(1)
    found = estimate_discrepancy(matches, fit, rng=rng, sample=matches, n_draws=500)
    u, v = (row["rms"] for row in found.facts["structure"])
    if size:
        assert u == pytest.approx(size, rel=0.35)
        assert v < size / 2
    else:
        assert max(u, v) < 0.1 * SIGMA
