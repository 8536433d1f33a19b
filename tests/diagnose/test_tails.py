"""Matches that a radius has cut, and tails that only look so."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.diagnose import score_tests
from bayesdist.infer import Rejection, fit_linear
from tests.reduced import case_in_full

from ..infer.support import residual_of
from .support import SIGMA, Scene, by_name, student, unequal

pytestmark = pytest.mark.usefixtures("one_thread")


def cut(scene: Scene, seed: int, sigmas: float, *, square: bool = False, soft: float = 0.0):
    """Tests of data that were matched within so many sigmas of a first solution."""
    model, table = scene.data(seed)
    r = residual_of(model, fit_linear(table, model, rejection=Rejection(clip_abs=None)).mean, table)
    r = r + soft * SIGMA * np.random.default_rng(seed).standard_normal(r.shape)
    inside = np.abs(r).max(axis=1) if square else np.hypot(*r.T)
    table = table.select(inside < sigmas * SIGMA)
    return table, scene.solve(model, table)


def truncation(table, solution, **options):
    return by_name(score_tests(table, solution, **options))["truncation"]


@pytest.mark.parametrize(
    ("n", "sigmas", "known"),
    [
        *((n, sigmas, known) for n, sigmas in ((800, 2.4), (4000, 3.0)) for known in (True, False)),
        (60_000, 4.0, False),
        case_in_full(60_000, 4.0, True, instead="a radius that is not known is found"),
    ],
)
def test_cuts_are_recognised(n, sigmas, known):
    """As far as stars are missing: beyond 4 sigma, 20 of 60,000."""
    radius = sigmas * SIGMA if known else None
    found = truncation(*cut(Scene(n, 2), 1, sigmas), match_radius=radius)
    assert found.significant and found.remedy.startswith("match again with a wider radius")
    assert "end too abruptly" in found.finding and "nothing of the quoted errors" in found.finding
    kept = 1 - np.exp(-(sigmas**2) / 2) * (1 + sigmas**2 / 2)
    kept /= 1 - np.exp(-(sigmas**2) / 2)
    # of the scatter, as far as it can be told from what is left
    assert found.size == pytest.approx(SIGMA * np.sqrt(1 - kept), rel=0.3)


def test_edges_may_be_square_soft_or_lie_among_false_matches():
    assert truncation(*cut(Scene(3000, 2), 1, 2.4, square=True)).significant
    assert truncation(*cut(Scene(3000, 2), 1, 2.4, soft=0.15)).significant
    assert truncation(*cut(Scene(2000, 2, fraction=0.05, mixture=True), 1, 2.4)).significant


def test_a_few_matches_beyond_an_edge_do_not_hide_it():
    table, fit = cut(Scene(2000, 2), 1, 2.4)
    u = table.u.copy()
    u[:2] += 8 * SIGMA
    table = table.with_columns(u=u)
    found = truncation(table, fit_linear(table, fit.model, rejection=Rejection(clip_abs=None)))
    assert found.significant


@pytest.mark.parametrize("n", [60, 1500, 60_000])
def test_clean_data_are_not_truncated(n):
    for seed in range(1 if n > 10_000 else 12):
        table, fit = Scene(n, 2).fitted(seed)
        for radius in (None, 5 * SIGMA):
            assert truncation(table, fit, match_radius=radius).p_value > 1e-3


def test_errors_quoted_too_large_are_not_taken_for_a_cut():
    """Chi-square is far below one in both."""
    table, fit = Scene(3000, 2).fitted(1)
    table = table.with_errors(1.5 * SIGMA)
    fit = fit_linear(table, fit.model, rejection=Rejection(clip_abs=None))
    assert fit.chi2 / fit.dof < 0.5
    found = truncation(table, fit)
    assert not found.significant and found.p_value > 0.05


@pytest.mark.parametrize(
    "scene",
    [
        Scene(1500, 2, noise=student), Scene(1500, 2, noise=unequal),
        Scene(1500, 2, misquoted=1.0), Scene(1500, 2, fraction=0.3),
    ],
)  # fmt: skip
def test_long_tails_and_wrong_errors_are_no_cut(scene):
    """Also where a radius lies in their midst: many are beyond it."""
    for seed in range(4):
        for radius in (None, 2.5 * SIGMA):
            assert truncation(*scene.fitted(seed), match_radius=radius).p_value > 0.05


def test_a_radius_far_beyond_the_true_matches_cuts_false_ones_only():
    scene = Scene(1500, 2, fraction=0.08, mixture=True)
    found = truncation(*cut(scene, 1, 15.0), match_radius=15.0 * SIGMA)
    assert found.p_value > 0.05


def test_smallest_is_what_is_just_found():
    """A cut that takes a little more than that is found, one that takes a third of it is not."""
    scene = Scene(4000, 2)
    smallest = truncation(*scene.fitted(1)).smallest
    cuts = np.linspace(2.5, 5.0, 200)
    x = cuts**2 / 2
    lost = SIGMA * np.sqrt(x / np.expm1(x))
    near = float(np.interp(1.15 * smallest, lost[::-1], cuts[::-1]))
    far = float(np.interp(smallest / 3, lost[::-1], cuts[::-1]))
    assert np.mean([truncation(*cut(scene, seed, near)).significant for seed in range(6)]) > 0.8
    assert np.mean([truncation(*cut(scene, seed, far)).significant for seed in range(6)]) < 0.2
