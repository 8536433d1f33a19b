"""Findings that others account for have the remedy of their cause."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import bayesdist as bd
from bayesdist.diagnose.score.exposures import SECOND_ORDER
from bayesdist.diagnose.score.noise import BY_POSITION
from bayesdist.diagnose.score.questions import POINTING, order_family
from bayesdist.diagnose.score.result import (
    CAUSES,
    Family,
    Outcome,
    cause_of,
    corrected,
    explains_more,
)
from bayesdist.diagnose.score.shape import SKEWNESS
from bayesdist.diagnose.score.truncation import RADIUS
from bayesdist.infer.posterior.checks import ChiSquare

from .shaped import CHIP, SIDE, SIGMA, gaussian, in_circle, matches_of, scaled, true_map

pytestmark = pytest.mark.usefixtures("one_thread")

RADIUS_OF_MATCH = replace(RADIUS, remedy="state another radius", present="they end inside")


def remedies(*found: tuple) -> dict[str, str]:
    """Remedies of families that were found with a statistic and degrees of freedom, by name."""
    outcomes = [
        Outcome(family, statistic, dof, None, 1e-12, 0.01, lambda level: 0.01, "pix")
        for family, statistic, dof in found
    ]
    return {test.name: test.remedy for test in corrected(outcomes)}


def test_the_first_cause_leads():
    order = order_family(4, 3)
    chain = [RADIUS_OF_MATCH, SKEWNESS, order, BY_POSITION]
    for cause, symptom in pairwise(chain):
        found = remedies((cause, 100, 12), (symptom, 100, 12))
        assert set(found.values()) == {cause.remedy}
    assert set(remedies(*((one, 100, 12) for one in chain)).values()) == {chain[0].remedy}
    assert remedies((BY_POSITION, 100, 12)) == {BY_POSITION.name: BY_POSITION.remedy}


@pytest.mark.parametrize(
    ("p_skewness", "noisy", "displaced"),
    [(1e-3, True, True), (0.05, True, False), (1e-3, False, False)],
)
def test_structure_that_widens_the_residuals_is_of_displaced_stars(p_skewness, noisy, displaced):
    """A hint of skewness suffices if noise and structure are found together, and only then."""
    order = order_family(4, 3)
    p_values = {order: 1e-12, SKEWNESS: p_skewness, BY_POSITION: 1e-12 if noisy else 0.5}
    outcomes = [
        Outcome(family, 100, 12, None, p, 0.01, lambda level: 0.01, "pix")
        for family, p in (p_values | {RADIUS_OF_MATCH: 0.5}).items()
    ]
    # with as many tests the skewness alone is not significant
    tests = {test.name: test for test in corrected([*outcomes, *[outcomes[-1]] * 20])}
    assert tests[order.name].significant and not tests[SKEWNESS.name].significant
    assert tests[order.name].remedy == (SKEWNESS if displaced else order).remedy
    assert ("the shape of the residuals" in tests[order.name].finding) == displaced


@pytest.mark.parametrize(("p_skewness", "displaced"), [(1e-3, True), (6e-3, False)])
def test_the_least_of_several_hints_is_no_hint_by_chance(p_skewness, displaced):
    """Of four shape tests the least p-value is below 0.01 in four of a hundred runs."""
    order = order_family(4, 3)
    p_values = {order: 1e-12, BY_POSITION: 1e-12, SKEWNESS: p_skewness}
    others = ("displaced stars", "skewness of a patch", "shape by position")
    p_values |= {Family(name, "", "", "", group="shape"): 0.5 for name in others}
    p_values[RADIUS_OF_MATCH] = 0.5
    outcomes = [
        Outcome(family, 100, 12, None, p, 0.01, lambda level: 0.01, "pix")
        for family, p in p_values.items()
    ]
    tests = {test.name: test for test in corrected([*outcomes, *[outcomes[-1]] * 20])}
    assert tests[order.name].remedy == (SKEWNESS if displaced else order).remedy


def test_no_finding_is_its_own_cause():
    names = list(CAUSES)
    for name, cause in CAUSES.items():
        # a cause that is found leads over itself, and over what comes after it
        assert cause_of({name}, {name}) == ""
        for symptom in set(cause.symptoms) & set(names):
            back = name in CAUSES[symptom].symptoms
            found = {name, symptom}
            assert not back or cause_of({name}, found) == "" or cause_of({symptom}, found) == ""


@pytest.mark.parametrize("n_exposures", [6, 12, 40])
def test_random_terms_of_exposures_are_no_curved_sky(n_exposures):
    """All functions of an exposure are as large as each other; 12 go with the pointing."""
    rng = np.random.default_rng(n_exposures)
    n = 6 * n_exposures
    squares = 1e3 * rng.standard_normal((2000, n)) ** 2
    taken = [explains_more((one[:12].sum(), 12), (one.sum(), n)) for one in squares]
    # the functions of the pointing are some of all, so that chance is below that of two samples
    assert np.mean(taken) < 0.015
    both = {"second": (SECOND_ORDER, 1e5, n), "pointing": (POINTING, 1e5 * 12 / n, 12)}
    assert set(remedies(*both.values()).values()) == {SECOND_ORDER.remedy}
    if n_exposures > 6:
        curved = remedies((SECOND_ORDER, 1e5, n), (POINTING, 0.9e5, 12))
        assert set(curved.values()) == {POINTING.remedy}


def warnings(matches) -> str:
    model = bd.build_model(matches, order=3, size=(SIDE, SIDE), name=CHIP.name)
    fit = bd.fit_linear(matches, model)
    posterior = bd.sample(fit, matches, seed=1, target_ess=200)
    return repr(bd.diagnose(posterior, matches, fit=fit, rng=1))


def test_false_matches_are_no_reason_to_change_errors():
    """A third of all matches are false, and even within a few errors of the true positions."""
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0.5, SIDE + 0.5, (2, 1500))
    uv = true_map(x, y) + SIGMA * gaussian(rng, 1500)
    uv += (rng.uniform(size=1500) < 0.35)[:, None] * in_circle(rng, 1500, 0.15)
    text = warnings(matches_of(x, y, uv))
    assert "too small" not in text and "kept false matches" in text


def test_errors_are_called_too_small_where_nothing_else_is_found():
    rng = np.random.default_rng(4)
    x, y = rng.uniform(0.5, SIDE + 0.5, (2, 1200))
    uv = true_map(x, y) + SIGMA * gaussian(rng, 1200)
    assert "they are too small" in warnings(matches_of(x, y, uv, SIGMA / 2))
    uv += 0.05 * scaled(x)[:, None] ** 4  # which order 3 does not hold
    text = warnings(matches_of(x, y, uv, SIGMA / 2))
    assert "raise model.order to 4" in text and "too small" not in text
    assert "follow that advice before the errors are changed" in text


def test_a_large_chi_square_may_be_the_catalogues():
    sentence = ChiSquare(2000.0, 1000.0).check().sentence
    assert "motions since its epoch" in sentence and "the jitter takes it up" in sentence
    assert "catalogue" not in ChiSquare(2000.0, 1000.0, catalogue=False).check().sentence
    assert not ChiSquare(1100.0, 1000.0).check().sentence


@pytest.mark.parametrize("cut_elsewhere", [False, True])
def test_a_displaced_group_does_not_exclude_a_cut_about_other_positions(cut_elsewhere):
    small = ChiSquare(500.0, 1000.0, cut_elsewhere=cut_elsewhere)
    names_cut = "the match radius has cut" in small.check(displaced=True).sentence
    assert names_cut == cut_elsewhere
    assert "the match radius has cut" in small.check().sentence


def test_a_radius_that_no_match_comes_near_is_named_beside_a_large_chi_square():
    suspect = ChiSquare(2000.0, 1000.0, radius_doubt="the match radius is 1 pix")
    assert (
        suspect.check().doubt and "the match radius is 1 pix; otherwise" in suspect.check().sentence
    )
    explained = suspect.check(["order 4"])
    assert not explained.doubt and "match radius" not in explained.sentence
    assert not ChiSquare(2000.0, 1000.0).check().doubt
    assert not ChiSquare(1100.0, 1000.0, radius_doubt="the match radius is 1 pix").check().doubt
