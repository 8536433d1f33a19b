"""Displacements by magnitude: trails of charge, which have a likely pattern, among any others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from bayesdist.diagnose.score.projection import projection_of, regressor_tests
from bayesdist.diagnose.score.questions import MAGNITUDE, functions_for, questions
from bayesdist.diagnose.score.sample import scored_sample
from bayesdist.diagnose.statistics import combined_p
from bayesdist.infer import GaussianPriors

from ...infer.patterned import moved
from ..support import Scene, assert_even, assert_no_smaller_than_chance

pytestmark = pytest.mark.usefixtures("one_thread")

SCENE = Scene(1500, 3)
SIDE = 800.0  # rows of its chip


def p_of_magnitude(seed: int, displaced=None, *, patterns: bool = True) -> float:
    """P-value of the test by magnitude, with or without the likely patterns."""
    model, table = SCENE.data(seed)
    if displaced is not None:
        table = moved(table, displaced(table))
    fit = SCENE.solve(model, table)
    sample = scored_sample(table, fit)
    [asked] = [question for question in questions(sample) if question.family is MAGNITUDE]
    if not patterns:
        asked = replace(asked, patterns=())
    functions = functions_for(sample, [asked])
    [found] = regressor_tests(
        projection_of(functions, np.asarray(fit.mean), GaussianPriors.none(model))
    )
    return found.p_value


def trails(table) -> np.ndarray:
    """0.0018 px per magnitude at the first row, nothing at the last."""
    return (0.0018 * table.mag * (1 - table.y / SIDE))[:, None] * [[0.0, 1.0]]


def bright_displaced(table) -> np.ndarray:
    """0.03 px for the brightest stars in the last row, in proportion to the flux."""
    return (0.03 * 10 ** (-0.4 * (table.mag - 10)) * table.y / SIDE)[:, None] * [[0.0, 1.0]]


@pytest.mark.parametrize("displaced", [trails, bright_displaced])
def test_likely_patterns_are_found_where_all_directions_together_are_not(displaced):
    of_all, of_patterns = (
        np.array([p_of_magnitude(seed, displaced, patterns=used) for seed in range(30)])
        for used in (False, True)
    )
    level = 1e-3 / 22  # for one finding among all tests
    assert np.median(of_patterns) < np.median(of_all) / 4
    assert (of_patterns < level).mean() > (of_all < level).mean() + 0.1


def test_other_dependences_on_magnitude_are_still_found():
    """A pattern that is none of the likely ones: half of the weight costs a factor of two."""

    def shear(table):
        far = 2 * table.x / 1000.0 - 1
        return (0.0035 * (table.mag - 14) * far)[:, None] * [[0.0, 1.0]]

    for seed in range(5):
        of_all, of_patterns = (p_of_magnitude(seed, shear, patterns=used) for used in (False, True))
        assert of_patterns < 2.01 * of_all < 1e-3


def test_nothing_is_found_where_magnitudes_displace_nothing(full):
    p = np.array([p_of_magnitude(seed) for seed in range(300 if full else 60)])
    assert_no_smaller_than_chance("magnitude", p)
    assert_even("magnitude", p)


def test_combined_p_values():
    assert combined_p([0.3], [1.0]) == pytest.approx(0.3)
    # tests that are the same count once, independent small ones in proportion to their weights
    assert combined_p([1e-9] * 4, [0.25] * 4) == pytest.approx(1e-9)
    assert combined_p([1e-9, 0.4, 0.6], [0.2, 0.4, 0.4]) == pytest.approx(5e-9, rel=1e-6)
    assert combined_p([0.0, 1.0], [0.5, 0.5]) == pytest.approx(2e-300)


def test_combined_p_values_of_dependent_tests_are_those_of_chance():
    """Two-sided normal tests with correlations of 0.6 and -0.9: small p-values are exact."""
    rng = np.random.default_rng(3)
    correlation = np.array([[1.0, 0.6, -0.9], [0.6, 1.0, -0.5], [-0.9, -0.5, 1.0]])
    z = rng.standard_normal((40_000, 3)) @ np.linalg.cholesky(correlation).T
    weights = [0.5, 0.25, 0.25]
    p = np.array([combined_p(row, weights) for row in 2 * stats.norm.sf(np.abs(z))])
    for level in (0.01, 1e-3):
        n = int((p < level).sum())
        assert stats.binom.sf(n - 1, len(p), 1.1 * level) > 1e-3, (level, n)
        assert stats.binom.cdf(n, len(p), 0.8 * level) > 1e-3, (level, n)
