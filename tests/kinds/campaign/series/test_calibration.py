"""Tables 1-3 of ACS ISR 2015-06 as truths: pulls, coverage, and what the two-step way gives."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, chi2

from bayesdist.kinds.campaign.series import fit_series
from tests.infer.calibration import over_seeds
from tests.reduced import only_in_full

from .campaign import ALPHA, BETA, FORMAL, LINES, SCATTER, SIGMA_ALPHA, SIGMA_BETA, campaign
from .straight import straight_lines

pytestmark = [pytest.mark.slow, only_in_full("tests/campaign has lines by two steps")]


def one(seed: int) -> dict[str, np.ndarray]:
    """Pulls of one simulated campaign, with the outliers in."""
    truth = campaign(seed)
    posterior = fit_series(truth.series, LINES, seed=seed)
    out = {"converged": np.array(posterior.convergence.converged)}
    for name, draws, true in (("alpha", posterior.alpha, ALPHA), ("beta", posterior.beta, BETA)):
        out[f"sigma {name}"] = draws.std(axis=0, ddof=1)
        out[f"pull {name}"] = (draws.mean(axis=0) - true) / out[f"sigma {name}"]
        for level in (0.683, 0.954):
            low, high = np.quantile(draws, [(1 - level) / 2, (1 + level) / 2], axis=0)
            out[f"covered {name} {level}"] = (low <= true) & (true <= high)
    out["scatter"] = posterior.scatter_sigma.mean(axis=0) / SCATTER
    # a new campaign of the same truth: what its exposures that do not lie off show
    later, (first, last) = campaign(seed + 10_000), truth.series.span
    good = ~later.off & (later.series.epoch >= first) & (later.series.epoch <= last)
    new = later.series.take(good)
    prediction = posterior.predict(new.epoch)
    z = (new.values - prediction.mean) / np.sqrt(prediction.sigma_new**2 + new.sigma**2)
    out["new 1"], out["new 2"] = (np.abs(z) < 1).mean(), (np.abs(z) < 2).mean()
    for name, weighted in (("plain", False), ("formal", True)):
        lines = straight_lines(truth.series, LINES, weighted=weighted)
        out[f"{name} pull"] = (lines.beta - BETA) / lines.sigma_beta
    clean = straight_lines(truth.series.take(~truth.off), LINES)
    out["clean ratio"] = out["sigma beta"] / clean.sigma_beta
    out["clean shift"] = (posterior.beta.mean(axis=0) - clean.beta) / clean.sigma_beta
    return out


@pytest.fixture(scope="module")
def runs() -> list[dict[str, np.ndarray]]:
    return over_seeds(one, 120)


def test_pulls_and_coverage(runs, capsys):
    assert np.mean([r["converged"] for r in runs]) >= 0.95
    n = len(runs)
    with capsys.disabled():
        for name, published in (("alpha", SIGMA_ALPHA), ("beta", SIGMA_BETA)):
            pulls = np.array([r[f"pull {name}"] for r in runs])
            sigma = np.mean([r[f"sigma {name}"] for r in runs], axis=0)
            print(
                f"\n{name}: rms of {n} pulls {np.sqrt((pulls**2).mean(axis=0)).round(2).tolist()}, "
                f"largest {np.abs(pulls).max():.2f}; sigma {sigma.round(9).tolist()}, "
                f"published {published.tolist()}"
            )
    for name in ("alpha", "beta"):
        pulls = np.array([r[f"pull {name}"] for r in runs])
        # as below, campaigns x segments are independent
        low, high = np.sqrt(chi2.ppf([0.001, 0.999], 2 * n) / (2 * n))
        assert low < np.sqrt((pulls**2).mean()) < high
        assert 0.8 < np.sqrt((pulls**2).mean()) < 1.2
        for level in (0.683, 0.954):
            covered = np.array([r[f"covered {name} {level}"] for r in runs])
            # the three coefficients of a campaign share their exposures: count campaigns x segments
            low, high = binom.ppf([0.001, 0.999], 2 * n, level) / (2 * n)
            assert low <= covered.mean() <= high, (name, level, covered.mean())
    ratio = np.array([r["scatter"] for r in runs]).mean()
    assert ratio == pytest.approx(1, abs=0.06)


def test_new_exposures_fall_where_they_are_expected(runs):
    n = len(runs) * 100  # some hundred good exposures each; the coefficients are correlated
    for key, level in (("new 1", 0.683), ("new 2", 0.954)):
        mean = np.mean([r[key] for r in runs])
        # beside the count's error each campaign's own scatter estimate moves all its intervals
        error = np.hypot(np.sqrt(level * (1 - level) / n), 0.1 * level / np.sqrt(len(runs)))
        assert abs(mean - level) < 4 * error


def test_formal_errors_alone_are_far_too_small(runs):
    """Why the scatter is a parameter."""
    formal = np.array([r["formal pull"] for r in runs])
    assert np.sqrt((formal**2).mean()) > 0.5 * SCATTER.mean() / FORMAL
    ours = np.array([r["pull beta"] for r in runs])
    assert np.sqrt((ours**2).mean()) < 1.2


def test_two_steps_and_one_agree_where_nothing_lies_off(runs):
    """Least squares that is told which exposures lie off: the same lines, the same errors."""
    ratio = np.array([r["clean ratio"] for r in runs])
    shift = np.array([r["clean shift"] for r in runs])
    assert np.median(ratio) == pytest.approx(1, abs=0.06)
    assert np.median(np.abs(shift)) < 0.35
