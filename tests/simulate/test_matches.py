"""Simulated matches have the statistics that they are asked for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.errors import InputError
from bayesdist.model import Chip, DistortionModel, TimeDependence
from bayesdist.simulate import simulate_matches

CHIPS = (
    Chip(2, "WFC2", (4096.0, 2048.0), (2048.0, 1024.0)),
    Chip(1, "WFC1", (4096.0, 2048.0), (2048.0, 1024.0)),
)


def simulated(n=20_000, *, seed=1, n_exposures=4, frames="shift_rotation", **options):
    model = DistortionModel(
        2, CHIPS, frames=frames, exposures=tuple(f"e{k}" for k in range(n_exposures))
    )
    rng = np.random.default_rng(seed)
    theta = rng.standard_normal(model.n_params)
    matches, truth = simulate_matches(model, theta, n, rng=rng, **options)
    return model, matches, truth


def residual(model, matches, truth):
    predicted = model.predict(
        truth.theta,
        matches.x,
        matches.y,
        epoch=matches.epoch,
        exposure=matches.exposure,
        chip=matches.chip_number,
    )
    return np.column_stack([matches.u, matches.v]) - predicted


def assert_standard_normal(values):
    assert stats.kstest(np.ravel(values), "norm").pvalue > 1e-3


def test_errors_are_the_quoted_ones():
    rng = np.random.default_rng(2)
    sigma = (rng.uniform(0.01, 0.1, 20_000), rng.uniform(0.02, 0.3, 20_000))
    model, matches, truth = simulated(sigma=sigma, fraction=0.0)
    np.testing.assert_array_equal(matches.sigma_u, sigma[0])
    np.testing.assert_array_equal(matches.sigma_v, sigma[1])
    assert not truth.false.any()
    white = residual(model, matches, truth) / np.column_stack(sigma)
    assert_standard_normal(white)
    assert abs(np.corrcoef(white.T)[0, 1]) < 4 / np.sqrt(20_000)


def test_jitter_is_added_in_quadrature_and_not_quoted():
    model, matches, truth = simulated(sigma=0.03, jitter=0.04, fraction=0.0)
    assert (matches.sigma_u == 0.03).all()
    assert_standard_normal(residual(model, matches, truth) / 0.05)


def test_errors_follow_the_magnitude():
    mag = np.linspace(10, 20, 5000)

    def sigma(m):
        return 0.01 * (m - 9), 0.02 * (m - 9)

    model, matches, truth = simulated(5000, sigma=sigma, mag=mag, fraction=0.0)
    np.testing.assert_array_equal(matches.mag, mag)
    np.testing.assert_allclose(matches.sigma_v, 0.02 * (mag - 9))
    quoted = np.column_stack([matches.sigma_u, matches.sigma_v])
    assert_standard_normal(residual(model, matches, truth) / quoted)


def test_the_fraction_of_false_matches():
    _, _, truth = simulated(fraction=0.03)
    assert stats.binomtest(int(truth.false.sum()), 20_000, 0.03).pvalue > 1e-3
    assert truth.fraction == 0.03


def test_gaussian_false_matches():
    model, matches, truth = simulated(fraction=0.2, sigma=0.01, outlier_scale=0.7)
    r = residual(model, matches, truth)
    assert_standard_normal(r[truth.false] / 0.7)
    assert_standard_normal(r[~truth.false] / 0.01)


def test_uniform_false_matches_fill_the_match_circle():
    model, matches, truth = simulated(
        fraction=0.2, sigma=0.01, outlier_scale=3.0, outliers="uniform"
    )
    r = residual(model, matches, truth)[truth.false]
    # equal areas are equally likely: radius squared and angle are uniform
    assert stats.kstest((r**2).sum(axis=1) / 9, "uniform").pvalue > 1e-3
    angle = np.arctan2(r[:, 1], r[:, 0])
    assert stats.kstest((angle + np.pi) / (2 * np.pi), "uniform").pvalue > 1e-3


def test_stars_fill_chips_and_exposures_evenly():
    model, matches, _ = simulated()
    assert matches.chip_numbers == (2, 1) and matches.exposure_names == model.exposures
    counts = np.bincount(matches.chip)
    assert stats.binomtest(int(counts[0]), 20_000, 0.5).pvalue > 1e-3
    np.testing.assert_array_equal(np.bincount(matches.exposure), 5000)
    for values, size in ((matches.x, 4096), (matches.y, 2048)):
        # over the whole area of the pixels, from 0.5 to n + 0.5
        assert stats.kstest((values - 0.5) / size, "uniform").pvalue > 1e-3
    # chip, exposure and position do not depend on each other
    table = np.histogram2d(matches.chip, matches.exposure, bins=(2, 4))[0]
    assert stats.chi2_contingency(table).pvalue > 1e-3
    assert stats.ks_2samp(matches.x[matches.chip == 0], matches.x[matches.chip == 1]).pvalue > 1e-3


def test_epochs_are_those_of_the_exposures():
    model = DistortionModel(
        2,
        CHIPS,
        time=TimeDependence((("u", 1, 0),), (2004.5,)),
        exposures=("a", "b", "c"),
    )
    rng = np.random.default_rng(3)
    theta = rng.standard_normal(model.n_params)
    epochs = np.array([2002.0, 2006.0, 2014.0])
    matches, truth = simulate_matches(model, theta, 3000, rng=rng, epochs=epochs, fraction=0.0)
    np.testing.assert_array_equal(matches.epoch, epochs[matches.exposure])
    assert_standard_normal(residual(model, matches, truth) / 0.05)


def test_the_generator_decides_everything():
    _, a, ta = simulated(seed=5)
    _, b, tb = simulated(seed=5)
    _, c, _ = simulated(seed=6)
    for name in ("x", "y", "u", "v", "chip", "exposure"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    np.testing.assert_array_equal(ta.false, tb.false)
    assert not np.array_equal(a.x, c.x)


def test_errors():
    with pytest.raises(InputError, match=r"unknown kind of outliers 'cauchy'.*gaussian or uniform"):
        simulated(100, outliers="cauchy")
    with pytest.raises(InputError, match="need magnitudes"):
        simulated(100, sigma=lambda m: (m, m))
