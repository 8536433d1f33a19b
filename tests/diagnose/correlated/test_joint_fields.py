"""Second-order terms and smooth fields of exposures, each of which is evidence for the other."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.diagnose.correlated.exposure_fields import OF_FIELD, _Fields, _joint_draws
from bayesdist.diagnose.correlated.neighbours import modes
from bayesdist.diagnose.correlated.priors import legendre_products
from tests.adversarial.fields import MIDDLE, SIDE, smooth

pytestmark = pytest.mark.usefixtures("one_thread")

QUADRATIC = ((2, 0), (1, 1), (0, 2))
GRID = np.geomspace(1e-5, 1e-1, 40)
N = 40_000


class Second:
    """A posterior of the scatter of second-order terms with a Gaussian likelihood of its log."""

    def __init__(self, scatter: float, width: float):
        self.grid, self.log_prior = GRID, np.full(len(GRID), -np.log(len(GRID)))
        self.log_evidence = stats.norm.logpdf(np.log(GRID), np.log(scatter), width)


def fields_at(amplitude: float, width: float) -> _Fields:
    prior = np.full(len(GRID), -np.log(len(GRID)))
    likelihood = stats.norm.logpdf(np.log(GRID), np.log(amplitude), width)
    return _Fields(GRID, np.full(len(GRID), 0.5), prior, likelihood, 0.25 * GRID)


def drawn(second: Second, fields: _Fields) -> tuple[np.ndarray, np.ndarray]:
    """Draws of the scatter, and of the amplitude."""
    of_terms, of_field = _joint_draws(second, fields, N, np.random.default_rng(1))
    return GRID[of_terms], GRID[of_field]


@pytest.mark.parametrize(("scatter", "width"), [(1e-3, 0.5), (1e-3, 3.0), (3e-2, 0.4)])
def test_draws_have_the_joint_posterior(scatter, width):
    """Against all pairs of a grid, with the prior that links them and the one that does not."""
    second, fields = Second(scatter, width), fields_at(4e-3, 0.6)
    density = np.exp(second.log_evidence + fields.log_likelihood[:, None])
    linked = np.abs(np.log(GRID) - np.log(0.25 * GRID)[:, None])
    linked = linked == linked.min(axis=1, keepdims=True)
    prior = (1 - OF_FIELD) / len(GRID) ** 2 + OF_FIELD * linked / len(GRID)
    density *= prior
    density /= density.sum()
    tau, amplitude = drawn(second, fields)
    for values, weight in ((tau, density.sum(axis=0)), (amplitude, density.sum(axis=1))):
        mean = weight @ np.log(GRID)
        sd = np.sqrt(weight @ (np.log(GRID) - mean) ** 2)
        assert np.log(values).mean() == pytest.approx(mean, abs=5 * sd / np.sqrt(N))
        assert np.log(values).std() == pytest.approx(sd, rel=0.03)
    together = np.mean(np.abs(np.log(tau / amplitude / 0.25)) < 0.15)
    assert together == pytest.approx(density[linked].sum(), abs=0.012)


def test_terms_that_a_field_cannot_have_leave_it_alone():
    """A scatter far above that of the field: the two are independent."""
    tau, amplitude = drawn(Second(3e-2, 0.1), fields_at(1e-3, 0.3))
    assert np.median(tau) == pytest.approx(3e-2, rel=0.3)
    assert np.median(amplitude) == pytest.approx(1e-3, rel=0.3)


@pytest.mark.parametrize("length", [0.2, 0.5])
def test_the_terms_of_a_field_are_those_of_simulated_ones(length):
    """Matérn fields by random waves: coefficients of the second order, of unit mean square."""
    Z = (np.arange(24) + 0.5) / 12 - 1
    X, Y = (z.ravel() for z in np.meshgrid(Z, Z))
    low = legendre_products(X, Y, ((0, 0), (1, 0), (0, 1), *QUADRATIC))
    squares = []
    for seed in range(150):
        rng = np.random.default_rng([20, seed])
        field = smooth(rng, length * SIDE / 2, 1.0, 1.5, expected=True)
        values = field(MIDDLE + X * SIDE / 2, MIDDLE + Y * SIDE / 2)
        squares.append(np.mean(np.linalg.lstsq(low, values)[0][3:] ** 2))
    expected = modes((SIDE, SIDE), length).second_order
    error = np.std(squares) / np.sqrt(len(squares))
    assert np.mean(squares) == pytest.approx(expected, abs=4 * error + 0.05 * expected)
