"""Alpha and beta of ACS ISR 2015-06, Tables 1 to 3, jointly and in two steps, over campaigns."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, norm

from bayesdist.missions.hst.simulate.distortion import SM4
from tests.campaign.support import (
    CHIPS,
    LOOSE,
    MATERN,
    PUBLISHED_SIGMA,
    PUBLISHED_SIZE,
    SEGMENTS,
    TERMS,
    TRUE_LINES,
)
from tests.reduced import case_in_full

pytestmark = pytest.mark.slow

# of 24 numbers of a campaign; the chips of an exposure share most of its scatter
INDEPENDENT = 12
CHANCE = 1e-3
WAYS = ("joint", "two")
SETTINGS = [
    pytest.param(MATERN, id="usual"),
    case_in_full(LOOSE, instead="test_hierarchy has chips that scatter alone", id="a loose chip"),
]
RDATE = (2004.5, 2012.5)


def pulls(found: list, way: str) -> np.ndarray:
    """(seeds, term, chip, segment, alpha and beta)."""
    return np.array([(one[f"{way} value"] - TRUE_LINES) / one[f"{way} sigma"] for one in found])


def band(independent: float) -> tuple[float, float]:
    """Where the rms of so many independent pulls lies but for a chance of 1 in 1000."""
    low, high = np.sqrt(chi2.ppf([CHANCE / 2, 1 - CHANCE / 2], independent) / independent)
    return float(low), float(high)


def rms(values: np.ndarray, axis=None) -> np.ndarray:
    return np.sqrt((values**2).mean(axis=axis))


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("setting", SETTINGS)
def test_pulls_are_standard_normal(campaigns, setting, way, full, capsys):
    found = pulls(campaigns[setting], way)
    n = len(found)
    with capsys.disabled():
        print(
            f"\n{setting.pattern}, {way}: rms of {found.size} pulls {rms(found):.3f}, "
            f"largest {np.abs(found).max():.2f}"
        )
        for k, kind in enumerate(("alpha", "beta")):
            for t, term in enumerate(TERMS):
                by = rms(found[:, t, ..., k], axis=0).ravel()
                print(f"  {kind} {term}: {rms(found[:, t, ..., k]):.2f} ({by.round(2)})")
    assert max(one["two monte carlo"] for one in campaigns[setting]) < 0.1
    low, high = band(INDEPENDENT * n)
    assert low < rms(found) < high
    if full:
        assert 0.8 < rms(found) < 1.2
    assert np.abs(found).max() < norm.isf(CHANCE / 2 / found.size)
    for t, term in enumerate(TERMS):
        for k, kind in enumerate(("alpha", "beta")):
            # two segments and, nearly the same, two chips
            low, high = band(2 * n)
            assert low < rms(found[:, t, ..., k]) < high, (term, kind)
            for c, chip in enumerate(CHIPS):
                assert low < rms(found[:, t, c, :, k]) < high, (term, kind, chip)


def test_both_ways_agree(campaigns, capsys):
    """One data set: their difference is less than the error of either."""
    found = campaigns[MATERN]
    joint, two = (np.array([one[f"{way} value"] for one in found]) for way in WAYS)
    s_joint, s_two = (np.array([one[f"{way} sigma"] for one in found]) for way in WAYS)
    apart = (joint - two) / np.hypot(s_joint, s_two)
    ratio = s_joint / s_two
    with capsys.disabled():
        print(f"\njoint less two steps: rms {rms(apart):.3f} of the errors in quadrature")
        print("sigma, joint over two steps, median of the campaigns (chip, segment by column):")
        for k, kind in enumerate(("alpha", "beta")):
            for t, term in enumerate(TERMS):
                print(f"  {kind} {term}: {np.median(ratio[:, t, ..., k], axis=0).ravel().round(2)}")
    assert rms(apart) < band(INDEPENDENT * len(found))[1]
    assert np.abs(apart).max() < norm.isf(CHANCE / 2 / apart.size)
    # jointly the terms of higher order are common to all exposures: lines are known no worse
    assert np.median(ratio, axis=0).max() < 1.3


@pytest.mark.parametrize("setting", SETTINGS)
def test_drifts_are_known_no_better_than_exposures_scatter(campaigns, setting, capsys):
    """A line through perfect exposures is as good as their scatter allows, and no fit is better.

    An exposure's deviation of B_2 is twice shear_cross, where A_3 is the gauge, and nothing tells
    it from the drift.  The gap between the chips is turned by the shear as the chips are; a fit
    that takes it for an independent measure of the roll angle is too sure of the drift.
    """
    ratios = []
    for one in campaigns[setting]:
        for s, date in enumerate(RDATE):
            dt = one["epoch"][(one["epoch"] > SM4) == bool(s)] - date
            line = np.column_stack([np.ones(len(dt)), dt])
            least = 2 * one["tau"]["shear_cross"] * np.sqrt(np.diag(np.linalg.inv(line.T @ line)))
            ratios.append(one["joint sigma"][TERMS.index("B_2"), :, s] / least)
    worst = np.min(ratios, axis=(0, 1))
    with capsys.disabled():
        print(
            f"\n{setting.pattern}: sigma of B_2 over what the scatter allows at least "
            f"{worst[0]:.2f} (alpha), {worst[1]:.2f} (beta)"
        )
    assert worst.min() > 0.95


def test_a_campaign_of_the_published_size(campaigns, capsys):
    """110 exposures: errors of the size of the published ones."""
    if PUBLISHED_SIZE not in campaigns:
        pytest.skip("110 exposures take minutes: set BAYESDIST_FULL=1")
    [one] = campaigns[PUBLISHED_SIZE]
    with capsys.disabled():
        print("\n| term | chip | RDATE | | published sigma | joint | two steps | pull |")
        print("|---|---|---|---|---|---|---|---|")
        for index in np.ndindex(TRUE_LINES.shape):
            t, c, s, k = index
            pull = (one["joint value"][index] - TRUE_LINES[index]) / one["joint sigma"][index]
            print(
                f"| {TERMS[t]} | WFC{CHIPS[c]} | {RDATE[SEGMENTS[s]]} | {('alpha', 'beta')[k]} "
                f"| {PUBLISHED_SIGMA[index]:.2e} | {one['joint sigma'][index]:.2e} "
                f"| {one['two sigma'][index]:.2e} | {pull:+.2f} |"
            )
    for way in WAYS:
        assert np.abs(pulls([one], way)).max() < norm.isf(CHANCE / 2 / TRUE_LINES.size)
        ratio = one[f"{way} sigma"] / PUBLISHED_SIGMA
        assert 0.5 < np.median(ratio) < 2.0
