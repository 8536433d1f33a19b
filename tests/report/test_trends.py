"""Residuals in bins: means, their errors, and patterns that have to be seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.infer.stars.stars import prepare
from bayesdist.report.plots.trends import means_in_bins

from .plots import plot_of
from .runs import report_run


def test_means_and_their_errors_are_the_weighted_ones():
    t = np.array([1.0, 2.0, 3.0, 11.0, 12.0])
    residual = np.array([[1.0, 2.0], [3.0, 2.0], [5.0, 2.0], [4.0, 0.0], [6.0, 1.0]])
    found = means_in_bins(t, residual, np.ones(5), np.array([0.0, 10.0, 20.0]))
    np.testing.assert_allclose(found.at, [2.0, 11.5])
    np.testing.assert_allclose(found.mean, [[3.0, 2.0], [5.0, 0.5]])
    sem = [
        values.std(ddof=1) / np.sqrt(len(values)) for values in (residual[:3, 0], residual[3:, 0])
    ]
    np.testing.assert_allclose(found.error[:, 0], sem)
    # a star of nearly no weight changes nothing
    light = means_in_bins(
        np.append(t, 2.5), np.vstack([residual, [99.0, 99.0]]), np.array([1, 1, 1, 1, 1, 1e-9]),
        np.array([0.0, 10.0, 20.0]),
    )  # fmt: skip
    np.testing.assert_allclose(light.mean, found.mean, rtol=1e-6)


def test_chi_square_of_means_of_noise_is_the_number_of_bins():
    rng = np.random.default_rng(4)
    t, residual = rng.uniform(0, 1, 40_000), rng.normal(size=(40_000, 2))
    found = means_in_bins(t, residual, np.ones(40_000), np.linspace(0, 1, 101))
    assert np.all(np.abs(found.chi2 - 100) < 4 * np.sqrt(200))


def _errorbars(ax):
    """Positions and values of the means in a panel."""
    (bars,) = ax.containers
    return bars[0].get_xydata().T


def test_a_step_between_columns_is_seen_where_it_is(converged):
    """Columns from 508.5 on are shifted by 0.05 pixels in u, and in nothing else."""
    stars = converged.diagnostics.sample
    moved = stars.posterior_residual + np.where(stars.table.x[:, None] > 508.5, [0.05, 0.0], 0.0)
    run = converged.having(sample=replace(stars, posterior_residual=moved))
    fig = plot_of(run, "residuals_by_column_and_row").figure
    steps = []
    for ax in fig.axes:  # u against x and y, v against x and y
        t, mean = _errorbars(ax)
        steps.append(mean[t > 508.5].mean() - mean[t < 508.5].mean())
    assert steps[0] == pytest.approx(0.05, abs=0.012)
    assert np.all(np.abs(steps[1:]) < 0.012)


def test_residuals_of_turned_exposures_are_along_the_detector(converged):
    """Frames that turn by nothing leave residuals as they are: two routes, one answer."""
    plots = plot_of(converged, "residuals_by_position")
    t, mean = _errorbars(plots.figure.axes[0])
    stars = converged.diagnostics.sample
    here = stars.probably_true
    weight = 1.0 / (stars.table.sigma_u[here] ** 2 + converged.posterior.likelihood.constants.j2[0])
    edges = np.linspace(0.5, 1016.5, len(t) + 1)
    k = np.digitize(stars.table.x[here], edges) - 1
    for cell in (0, len(t) - 1):
        value = np.average(stars.residual[here][k == cell, 0], weights=weight[k == cell])
        assert mean[cell] == pytest.approx(value, rel=1e-6)


def test_chi_square_of_an_exposure_with_larger_errors_is_outside(converged):
    stars = converged.diagnostics.sample
    worse = stars.table.exposure == 2
    moved = np.where(worse[:, None], 1.5, 1.0) * stars.posterior_residual
    run = converged.having(sample=replace(stars, posterior_residual=moved))
    plot = plot_of(run, "chi_square_by_exposure")
    ratio = plot.figure.axes[0].lines[-1].get_ydata()
    before = plot_of(converged, "chi_square_by_exposure").figure.axes[0].lines[-1].get_ydata()
    np.testing.assert_allclose(ratio / before, [1, 1, 2.25, 1], rtol=1e-6)
    assert "the farthest is frame2" in plot.text


def test_coverage_counts_the_stars_that_are_probably_true(converged):
    (image,) = plot_of(converged, "coverage").figure.axes[0].images
    stars, _ = prepare(converged.model, converged.diagnostics.sample.table)
    true = converged.posterior.likelihood.inliers(stars) > 0.5
    assert image.get_array().sum() == true.sum() < len(converged.diagnostics.sample)


def test_pixel_scale_is_the_root_of_the_area():
    run = report_run(unit="arcsec", scale=0.05)
    plot = plot_of(run, "pixel_scale")
    area = run.evaluation.areas[0]
    text = f"from {1e3 * np.sqrt(area.area.min() * area.reference_area):.6g} to"
    assert text in plot.text and "mas/pix" in plot.figure.axes[1].get_ylabel()


def test_dates_of_one_night_are_in_days(converged):
    stars = converged.diagnostics.sample
    hours = np.array([0.0, 1.0, 2.0, 6.0])[stars.table.exposure % 4]
    night = stars.table.with_columns(epoch=2020.194906 + hours / 24 / 365.25)
    plot = plot_of(converged.having(sample=replace(stars, table=night)), "residuals_by_property")
    axes = [ax for ax in plot.figure.axes if "epoch" in ax.get_xlabel()]
    assert len(axes) == 2
    for ax in axes:
        assert ax.get_xlabel() == "epoch [days after the first]"
        np.testing.assert_allclose(_errorbars(ax)[0], np.array([0, 1, 2, 6]) / 24, atol=1e-6)
