"""Errors of positions cover, with truths that the fitted model cannot reproduce."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.terms.correlated import StructureErrors
from bayesdist.diagnose.correlated import DiscrepancyPriors, estimate_discrepancy
from bayesdist.errors import InputError
from bayesdist.model.grid import grid_pixels, mesh
from tests.diagnose.correlated.skies import SIZE, matched, smooth
from tests.reduced import only_in_full

GRID = (9, 9)
SEEDS = 40


def within(n, make, seed):
    """Fractions of the grid within 1 and 1.96 sigmas, and mean squares, actual and stated."""
    rng = np.random.default_rng([seed, n])
    fit, table, true = matched(n, rng, *make(rng))
    found = estimate_discrepancy(table, fit, rng=rng)
    x, y = mesh(*grid_pixels((SIZE, SIZE), GRID))
    phi = fit.model.basis(1).evaluate(x, y)
    K = fit.model.n_terms
    parts = [found.covariance[a * K : (a + 1) * K, a * K : (a + 1) * K] for a in (0, 1)]
    of_fit = np.stack([np.einsum("nk,kl,nl->n", phi, part, phi) for part in parts], axis=1)
    local = StructureErrors(found).sigma(EvaluationDomain.of_chips(fit.model, GRID))
    sigma = np.sqrt(of_fit + local**2)
    error = true(x, y) - fit.model.predict(fit.mean, x, y)
    inside = [np.mean(np.abs(error) < k * sigma) for k in (1.0, 1.96)]
    return *inside, np.mean(error**2), np.mean(sigma**2)


def nothing(rng):
    return ()


def field(rng):
    return (smooth(rng, 270.0, 0.004),)


@pytest.mark.slow
@only_in_full("tests/coverage has runs with a pattern")
@pytest.mark.parametrize(
    ("make", "n", "most"),
    [
        pytest.param(nothing, 1500, 1.3, id="inside"),
        pytest.param(field, 3000, 1.25, id="field"),
    ],
)
def test_positions_are_within_their_errors_as_often_as_said(make, n, most):
    found = np.array([within(n, make, seed) for seed in range(SEEDS)])
    one, two, actual, stated = found.mean(axis=0)
    assert 0.60 < one < 0.85 and two > 0.90
    assert 1 / most < np.sqrt(stated / actual) < most


def test_without_the_structure_the_same_positions_are_not_covered():
    """Errors by the likelihood alone: a test of the test above."""
    rng = np.random.default_rng(1)
    fit, _, true = matched(3000, rng, *field(rng))
    x, y = mesh(*grid_pixels((SIZE, SIZE), GRID))
    phi, K = fit.model.basis(1).evaluate(x, y), fit.model.n_terms
    cov = np.asarray(fit.cov)
    parts = [cov[a * K : (a + 1) * K, a * K : (a + 1) * K] for a in (0, 1)]
    sigma = np.sqrt(np.stack([np.einsum("nk,kl,nl->n", phi, p, phi) for p in parts], axis=1))
    error = true(x, y) - fit.model.predict(fit.mean, x, y)
    assert np.mean(np.abs(error) < sigma) < 0.5


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_a_prior_without_a_size_is_refused(value):
    with pytest.raises(InputError, match="structure"):
        DiscrepancyPriors(structure=value)
