"""The curve over the residual histogram is the mixture that was fitted, star by star."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from bayesdist.diagnose.residuals.binned import binned_residuals
from bayesdist.report.figures.arrows import CHANCE, significant_cells
from bayesdist.report.plots.residuals import MixtureCurve
from bayesdist.report.sections.posterior import outlier_table


def test_counts_add_up_to_the_stars():
    sigma = np.random.default_rng(1).lognormal(-3.0, 0.5, 5000)
    for outliers, scale in (("none", 0.0), ("gaussian", 0.8), ("uniform", 2.0)):
        good, bad = MixtureCurve(sigma, 0.2, 0.01, scale, outliers).expected([-50.0, 50.0])
        assert good.sum() + bad.sum() == pytest.approx(5000, rel=1e-12)
        assert bad.sum() == pytest.approx(0.0 if outliers == "none" else 1000.0, rel=1e-12)


@pytest.mark.parametrize(
    ("model", "said"),
    [("gaussian", "errors of f and s_out are"), ("uniform", "error of f is"), ("none", None)],
)
def test_the_table_says_what_its_errors_hold_for(converged, model, said):
    post = converged.posterior
    hyper = {k: v for k, v in post.hyper.items() if k != "s_out" or model == "gaussian"}
    radius = 3.0 if model == "uniform" else None
    mixture = replace(post.mixture, model=model, match_radius=radius)
    note = outlier_table(
        converged.having(posterior=replace(post, mixture=mixture, hyper=hyper))
    ).note
    assert said is None or f"The {said} for false matches of this shape" in note
    assert ("of this shape" in note) == (said is not None)


def test_many_errors_in_few_steps_are_the_sum_over_stars():
    sigma = np.random.default_rng(2).lognormal(-3.0, 0.7, 20_000)
    edges = np.linspace(-0.3, 0.3, 61)
    good, _ = MixtureCurve(sigma, jitter=0.02).expected(edges)
    width = np.sqrt(sigma**2 + 0.02**2)
    exact = sum(np.diff(norm.cdf(edges / w)) for w in width)
    np.testing.assert_allclose(good, exact, rtol=3e-4)


@pytest.mark.parametrize("outliers", ["gaussian", "uniform"])
def test_simulated_residuals_follow_the_curve(outliers):
    rng = np.random.default_rng(3)
    n, f, j, scale = 200_000, 0.05, 0.02, 1.5
    sigma = rng.uniform(0.02, 0.1, n)
    r = rng.normal(size=n) * np.hypot(sigma, j)
    false = rng.random(n) < f
    if outliers == "gaussian":
        r[false] = rng.normal(0, scale, false.sum())
    else:
        radius, angle = (
            scale * np.sqrt(rng.random(false.sum())),
            rng.uniform(0, 2 * np.pi, false.sum()),
        )
        r[false] = radius * np.cos(angle)
    edges = np.linspace(-1.6, 1.6, 81)
    counts, _ = np.histogram(r, edges)
    expected = sum(MixtureCurve(sigma, f, j, scale, outliers).expected(edges))
    kept = expected > 10
    chi2 = ((counts - expected)[kept] ** 2 / expected[kept]).sum()
    dof = int(kept.sum())
    assert abs(chi2 - dof) < 5 * np.sqrt(2 * dof)


def test_residuals_about_fitted_means_follow_the_curve():
    """Stars of three detections each, placed at their mean: a third of the variance is gone."""
    rng = np.random.default_rng(6)
    r = 0.05 * rng.normal(size=(60_000, 3))
    r = (r - r.mean(axis=1, keepdims=True)).ravel()
    edges = np.linspace(-0.15, 0.15, 31)
    counts, _ = np.histogram(r, edges)
    curve = MixtureCurve(np.full(r.size, 0.04), jitter=0.03, taken=np.full(r.size, 1 / 3))
    expected = sum(curve.expected(edges))
    # three residuals of a star are not independent, and sum to zero
    assert np.abs(counts - expected).max() < 6 * np.sqrt(expected.max())


@pytest.mark.parametrize("per_cell", [250, 12])
def test_noise_alone_makes_as_many_cells_dark_as_the_caption_says(per_cell):
    rng = np.random.default_rng(4)
    n, size = 1600 * per_cell, (1000.0, 1000.0)
    x, y = rng.uniform(0.5, 1000.5, (2, n))
    binned = binned_residuals(x, y, *rng.normal(size=(2, n)), bins=(40, 40), size=size)
    found = significant_cells(binned).mean()
    assert found == pytest.approx(CHANCE, abs=4 * np.sqrt(CHANCE / 1600))
