"""Exposures that deviate from all others: what they do to the fit of all."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.diagnose.correlated.deviations import LinearDeviations, linear_deviations
from bayesdist.diagnose.correlated.estimate import _by_exposure
from bayesdist.diagnose.correlated.information import Information
from bayesdist.diagnose.correlated.priors import DiscrepancyPriors
from bayesdist.infer import GaussianPriors
from bayesdist.infer.solution.solution import likelihood_of
from bayesdist.model import DistortionModel

from ...infer.patterned import mode_of
from ..score.shaped import CHIP, SIDE, SIGMA, gaussian, matches_of, true_map

pytestmark = pytest.mark.usefixtures("one_thread")

N_EXPOSURES, OUTLYING, N = 8, 5, 2000
MODEL = DistortionModel(3, (CHIP,))


def turned(seed: int, degrees: float):
    """Stars of eight exposures, one of which is turned about the middle of the detector."""
    rng = np.random.default_rng([15, seed])
    x, y = rng.uniform(0.5, SIDE + 0.5, (2, N))
    code = np.arange(N) % N_EXPOSURES
    uv = true_map(x, y) + SIGMA * gaussian(rng, N)
    off = np.radians(degrees) * np.stack([-(y - SIDE / 2), x - SIDE / 2], axis=1)
    uv += (code == OUTLYING)[:, None] * off
    names = tuple(f"e{k}" for k in range(N_EXPOSURES))
    return matches_of(x, y, uv, exposure=code, exposure_names=names)


def deviations(matches, solution) -> tuple[LinearDeviations, np.ndarray]:
    """With the information of the parameters (D, D)."""
    likelihood = likelihood_of(solution)
    sums = _by_exposure(matches, likelihood, MODEL)
    information = Information(MODEL, likelihood.theta, sums, GaussianPriors.none(MODEL))
    found = linear_deviations(
        information,
        information,
        DiscrepancyPriors(),
        400,
        np.random.default_rng(1),
        exposures=True,
    )
    assert found is not None
    return found, information.precision


@pytest.mark.parametrize("degrees", [0.003, 0.005, 0.02])
def test_the_expected_error_is_the_difference_to_a_fit_without_the_exposure(degrees):
    """Stars of the turned exposure are off by up to 4 or 18 errors: many count as false."""
    for seed in range(2):
        matches = turned(seed, degrees)
        solution = mode_of(matches, MODEL)[0]
        found, precision = deviations(matches, solution)
        assert found.outlying == (OUTLYING,)
        others = mode_of(matches.select(matches.exposure != OUTLYING), MODEL)[0]
        difference = np.asarray(others.mean) - np.asarray(solution.mean)
        predicted = found.theta.mean(axis=0)
        left = predicted - difference
        assert left @ precision @ left < 0.02 * (difference @ precision @ difference) + 0.2


def test_exposures_that_agree_leave_the_fit_alone():
    matches = turned(0, 0.0)
    solution = mode_of(matches, MODEL)[0]
    found, precision = deviations(matches, solution)
    assert not found.outlying
    sigma = np.sqrt(np.diag(np.linalg.inv(precision)))
    assert np.abs(found.theta.mean(axis=0) / sigma).max() < 0.3
