"""Match radii that are stated as they were, and others."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.diagnose.score.truncation import _level_then_steep
from bayesdist.infer import OutlierMixture
from bayesdist.utils.checks import EITHER

from .shaped import SIGMA, examined, gaussian, nominal_within, scene, student, true_map, unequal

pytestmark = pytest.mark.usefixtures("one_thread")

NAME = "match radius"


def at_radius(matches, model: str, stated: float):
    mixture = OutlierMixture(model, match_radius=stated)
    return examined(matches, 3, mixture, stated)[NAME]


@pytest.mark.parametrize("nominal", [True, False])
@pytest.mark.parametrize("model", ["uniform", "gaussian"])
def test_matches_that_end_far_inside_are_found(model, nominal):
    """Stated is 1.0 px, and the matches were cut at 0.25 px; the nominal map is off by 0.01 px."""
    matches, _ = nominal_within(np.random.default_rng(1), 4000, 0.25, off=0.01)
    if not nominal:
        matches = matches.with_columns(u_nominal=None, v_nominal=None)
    found = at_radius(matches, model, 1.0)
    assert found.significant and found.p_value < 1e-9 and found.doubt == EITHER
    assert "far inside the stated match radius of 1 pix" in found.finding
    stated = float(found.remedy.split("outliers.match_radius = ")[1].split(",")[0])
    assert stated == pytest.approx(0.25, rel=0.01 if nominal else 0.2)
    assert stated > 0.249
    assert ("u_nominal" in found.remedy) == (not nominal)


def test_the_number_that_is_expected_is_that_of_even_matches():
    """Those that lie beyond the end of others that are even within the radius."""
    rng = np.random.default_rng(2)
    inside, _ = nominal_within(rng, 3000, 0.25, false=0.2)
    found = at_radius(inside, "uniform", 1.0)
    number, end = (
        float(found.finding.split(word)[0].split()[-1]) for word in (" false", " pix from")
    )
    n_false = 0.2 * 3000  # in 0.25 px: sixteen times as many in 1 px
    assert number == pytest.approx(n_false * (1.0 - end**2) / 0.25**2, rel=0.15)


def test_true_matches_that_were_cut_are_found():
    """Without false ones, about nominal positions that are off."""
    rng = np.random.default_rng(3)
    matches, n_cut = nominal_within(rng, 4000, 0.12, sigma=0.04, off=0.04, false=0.0)
    found = at_radius(matches, "uniform", 1.0)
    assert found.significant and "true ones are expected" in found.finding
    number = float(found.finding.split(" true")[0].split()[-1])
    # the solution has followed the cut in part
    assert 0.3 * n_cut < number < 1.5 * n_cut


def test_matches_beyond_the_radius_are_found():
    matches, _ = nominal_within(np.random.default_rng(4), 3000, 0.4, off=0.01)
    blind = matches.with_columns(u_nominal=None, v_nominal=None)
    for model in ("uniform", "gaussian"):
        found = at_radius(blind, model, 0.15)
        assert found.significant and found.doubt == EITHER
        assert "larger than 1.25 times the stated match radius of 0.15 pix" in found.finding


@pytest.mark.parametrize("model", ["uniform", "gaussian"])
def test_radii_that_are_right_are_not_doubted(model):
    for false in (0.02, 0.35):
        for off in (0.01, 0.05):
            matches, _ = nominal_within(np.random.default_rng(5), 1500, 0.5, off=off, false=false)
            assert at_radius(matches, model, 0.5).p_value > 1e-3
            blind = matches.with_columns(u_nominal=None, v_nominal=None)
            assert at_radius(blind, model, 0.5).p_value > 1e-3


@pytest.mark.parametrize("noise", [gaussian, student, unequal])
def test_tails_of_the_noise_do_not_end_at_a_radius(noise):
    """Where no match is false, and the radius is fifty errors, also about nominal positions."""
    for seed in range(3):
        matches = scene(np.random.default_rng(seed), 2000, noise=noise, false=0.0)
        assert at_radius(matches, "uniform", 50 * SIGMA).p_value > 1e-3
        off = true_map(matches.x, matches.y) + np.array([4 * SIGMA, 0.0])
        about = matches.with_columns(u_nominal=off[:, 0], v_nominal=off[:, 1])
        assert at_radius(about, "uniform", 50 * SIGMA).p_value > 1e-3


def test_a_cut_about_positions_that_are_off_is_found_although_it_is_blurred():
    """Nominal positions are off by 1.5 errors, and are not given."""
    n_found = 0
    for seed in range(5):
        rng = np.random.default_rng(seed)
        matches, _ = nominal_within(rng, 2000, 0.25, sigma=0.04, off=0.06, false=0.2)
        blind = matches.with_columns(u_nominal=None, v_nominal=None)
        n_found += at_radius(blind, "uniform", 1.0).significant
    assert n_found >= 4


def test_level_then_steep_is_uniform_for_exponentials_and_never_small_for_their_mixtures(rng):
    exponential = np.sort(rng.exponential(size=(4000, 30)))
    mixed = np.sort(rng.exponential(size=(4000, 30)) * rng.gamma(2.0, size=(4000, 30)))
    for p in (0.5, 0.1, 0.01):
        chance = np.mean([_level_then_steep(values) < p for values in exponential])
        assert chance == pytest.approx(p, abs=4 * np.sqrt(p * (1 - p) / 4000))
        assert np.mean([_level_then_steep(values) < p for values in mixed]) < 0.6 * p
    even = np.sort(rng.uniform(size=(100, 100)))
    assert np.median([_level_then_steep(values) for values in even]) < 1e-7


def test_false_matches_with_a_scatter_of_their_own_are_what_a_gaussian_says():
    matches = scene(np.random.default_rng(6), 2000, false=0.2)
    assert at_radius(matches, "gaussian", 5.0).p_value > 1e-3
