"""Where the answer is known: generalised least squares, textbook lines, integrals over one axis."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.infer.kernel import precisions
from bayesdist.kinds.campaign.series import (
    Design,
    Series,
    TrendModel,
    exposure_folds,
    fit_series,
    held_out,
)
from bayesdist.kinds.campaign.series.problem import WIDE, SeriesProblem, trend_equations
from tests.reduced import case_in_full

from .straight import straight_lines

SCATTER = np.array([[1.0, 0.6], [0.6, 2.0]])


def some_series(rng, n=40) -> Series:
    """Two coefficients with formal errors that are correlated and differ from exposure to
    exposure."""
    epoch = rng.uniform(2002, 2014, n)
    root = rng.standard_normal((n, 2, 2)) * 0.5
    cov = root @ np.swapaxes(root, 1, 2)
    values = rng.multivariate_normal([3.0, -5.0], SCATTER, n) + np.outer(epoch - 2008, [0.3, -0.1])
    return Series(epoch, values, cov, ("a", "b"))


def least_squares(series: Series, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Dense generalised least squares (k p) and its covariance, with the vague prior."""
    n, k = series.values.shape
    big = np.zeros((n * k, n * k))
    design = np.zeros((n * k, k * columns.shape[1]))
    for e in range(n):
        rows = slice(e * k, (e + 1) * k)
        big[rows, rows] = series.cov[e] + SCATTER
        design[rows] = np.kron(np.eye(k), columns[e])
    weight = np.linalg.inv(big)
    prior = np.diag(np.repeat((WIDE * series.spread) ** -2, columns.shape[1]))
    cov = np.linalg.inv(design.T @ weight @ design + prior)
    y = (series.values - series.centre).ravel()
    return cov @ design.T @ weight @ y, cov


@pytest.mark.parametrize(
    "trend",
    [TrendModel("line"), TrendModel("lines", (2009.4,)), TrendModel("piecewise", (2006.0, 2010.0))],
)
def test_known_scatter_is_generalised_least_squares(trend, rng):
    series = some_series(rng)
    design = Design(trend, series)
    problem = SeriesProblem.of(series, design, SCATTER, outliers=False)
    columns = problem.columns(np.zeros((1, 0)))
    precision = precisions(problem.formal, problem.sigma[None])
    matrix, right = trend_equations(problem, precision, columns, np.ones((1, 2)))
    unit = np.repeat(series.spread, design.n_columns)
    mean, cov = least_squares(series, columns[0])
    np.testing.assert_allclose(np.linalg.solve(matrix[0], right[0]) * unit, mean, rtol=1e-8)
    np.testing.assert_allclose(np.linalg.inv(matrix[0]) * np.outer(unit, unit), cov, rtol=1e-7)


def test_draws_are_those_of_generalised_least_squares(rng):
    series = some_series(rng)
    trend = TrendModel("lines", (2009.4,))
    posterior = fit_series(series, trend, scatter=SCATTER, outliers=False)
    columns = Design(trend, series).matrix(series.epoch, series.group_code)[0]
    mean, cov = least_squares(series, columns)
    b = posterior.raw.b.reshape(-1, *posterior.raw.b.shape[2:]) * series.spread[:, None]
    white = np.linalg.solve(np.linalg.cholesky(cov), (b.reshape(len(b), -1) - mean).T)
    # nothing else is sampled, so that the draws are independent
    n = white.shape[1]
    assert np.abs(white.mean(axis=1)).max() < 4.5 / np.sqrt(n)
    np.testing.assert_allclose(np.cov(white), np.eye(len(white)), atol=4.5 * np.sqrt(2 / n))
    assert posterior.convergence.converged


def test_textbook_line(rng):
    """Equal errors: sigma_beta = s / (sqrt(n) sd(t)) and sigma_alpha = s / sqrt(n) at the mean."""
    n, s = 60, 0.02
    epoch = rng.uniform(2002, 2007, n)
    values = 0.98 - 3e-3 * (epoch - 2004.5) + s * rng.standard_normal(n)
    series = Series.of(epoch, values, s, coefficients=("A_2",))
    weighted = straight_lines(series, TrendModel("line"), weighted=True)
    assert weighted.sigma_alpha[0, 0] == pytest.approx(s / np.sqrt(n), rel=1e-9)
    assert weighted.sigma_beta[0, 0] == pytest.approx(s / np.sqrt(n) / epoch.std(), rel=1e-9)
    free = straight_lines(series, TrendModel("line", reference=(2004.5,)))
    book = stats.linregress(epoch - 2004.5, values)
    assert free.beta[0, 0] == pytest.approx(book.slope, rel=1e-9)
    assert free.alpha[0, 0] == pytest.approx(book.intercept, rel=1e-12)
    assert free.sigma_beta[0, 0] == pytest.approx(book.stderr, rel=1e-9)
    assert free.sigma_alpha[0, 0] == pytest.approx(book.intercept_stderr, rel=1e-9)
    posterior = fit_series(series, TrendModel("line"), scatter=[[0.0]], outliers=False)
    assert posterior.beta.std() == pytest.approx(s / np.sqrt(n) / epoch.std(), rel=0.04)


@pytest.mark.parametrize(
    "formal",
    [
        case_in_full(0.0, instead="formal errors beside the scatter are run"),
        0.3,
        case_in_full(3.0, instead="formal errors beside the scatter are run"),
    ],
)
def test_one_scatter_is_a_one_dimensional_integral(formal, rng):
    """Scatter and slope against quadrature, from no formal errors to formal errors above all."""
    n = 30
    epoch = rng.uniform(2002, 2014, n)
    values = rng.standard_normal(n) + formal * rng.standard_normal(n) + 0.1 * (epoch - 2008)
    series = Series.of(epoch, values, formal, coefficients=("a",))
    trend = TrendModel("line")
    columns = Design(trend, series).matrix(epoch, series.group_code)[0]
    y, unit = values - series.centre[0], series.spread[0]
    grid = np.exp(np.linspace(np.log(1e-4), np.log(30), 4000)) * unit
    v = grid[:, None, None] ** 2 + formal**2
    cov = np.linalg.inv(columns.T @ columns / v + np.eye(2) / (WIDE * unit) ** 2)
    b = cov @ (columns.T @ y)[:, None] / v
    mean, variance, v = b[:, 1, 0], cov[:, 1, 1], v[:, 0, 0]
    log_p = -0.5 * (n * np.log(v) - np.linalg.slogdet(cov)[1] + y @ y / v)
    log_p += 0.5 * (b * np.linalg.solve(cov, b)).sum(axis=(1, 2))
    log_p += stats.t(2, scale=unit).logpdf(grid) + np.log(grid)
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    years = Design(trend, series).years
    beta = p @ mean / years
    sigma_beta = np.sqrt(p @ (variance + mean**2) - (p @ mean) ** 2) / years
    posterior = fit_series(series, trend, outliers=False, target_ess=2000)
    assert posterior.convergence.converged
    ess = posterior.convergence.ess_bulk_min
    assert posterior.beta.mean() == pytest.approx(beta, abs=4.5 * sigma_beta / np.sqrt(ess))
    assert posterior.beta.std() == pytest.approx(sigma_beta, rel=4.5 / np.sqrt(2 * ess))
    quantiles = np.interp([0.1, 0.25, 0.5, 0.75, 0.9], np.cumsum(p), grid)
    below = [(posterior.scatter_sigma[:, 0] < q).mean() for q in quantiles]
    np.testing.assert_allclose(below, [0.1, 0.25, 0.5, 0.75, 0.9], atol=4.5 * 0.5 / np.sqrt(ess))


def test_held_out_density_of_a_constant(rng):
    """Known scatter, no outliers: each exposure's density from the others is a Gaussian."""
    n, k = 30, 2
    values = rng.multivariate_normal([0, 0], SCATTER, n)
    series = Series.of(rng.uniform(2002, 2014, n), values, coefficients=("a", "b"))
    posterior = fit_series(series, TrendModel("constant"), scatter=SCATTER, outliers=False)
    got = held_out(posterior, exposure_folds(series.epoch, n))
    expected = np.empty(n)
    for e in range(n):
        others = np.delete(values, e, axis=0)
        wide = SCATTER * (1 + 1 / (n - 1))
        expected[e] = stats.multivariate_normal(others.mean(axis=0), wide).logpdf(values[e])
    expected += np.log(series.spread).sum()
    assert got.total == pytest.approx(expected.sum(), abs=4 * got.mc_error)
    assert got.mc_error < 0.3
    sd = np.sqrt(np.diag(SCATTER) * (1 + 1 / (n - 1)))
    middle = (values.sum(axis=0) - values) / (n - 1)
    np.testing.assert_allclose(got.rank, stats.norm.cdf((values - middle) / sd), atol=0.06)
    assert got.rank.shape == (n, k)


def test_date_of_a_break_is_a_sum_over_gaps(rng):
    """Known scatter, no outliers: the date's posterior by dense Gaussians, gap by gap."""
    n = 40
    epoch = np.sort(rng.uniform(2002, 2014, n))
    values = rng.standard_normal(n) + 1.2 * (epoch > 2007)
    series = Series.of(epoch, values, coefficients=("a",))
    posterior = fit_series(
        series, TrendModel("step", find=1), scatter=[[1.0]], outliers=False, target_ess=1500
    )
    assert posterior.convergence.converged
    y, unit = values - series.centre[0], series.spread[0]
    log_p = np.full(n - 1, -np.inf)
    for g in range(4, n - 5):  # each segment keeps at least five exposures
        after = (np.arange(n) > g).astype(float)
        columns = np.stack([1 - after, after], axis=1)
        cov = np.eye(n) + (WIDE * unit) ** 2 * columns @ columns.T
        log_p[g] = stats.multivariate_normal(np.zeros(n), cov).logpdf(y)
        log_p[g] += np.log(epoch[g + 1] - epoch[g])
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    gap = np.searchsorted(epoch, posterior.breaks[:, 0]) - 1
    share = np.bincount(gap, minlength=n - 1) / len(gap)
    assert p.max() < 0.9  # else the test would see one gap only
    ess = posterior.convergence.ess_bulk_min
    np.testing.assert_allclose(share, p, atol=4.5 * 0.5 / np.sqrt(ess))
    assert np.abs(share - p).sum() < 0.15
    # inside a gap any date is as probable as any other
    likely = int(np.argmax(p))
    inside = posterior.breaks[gap == likely, 0]
    place = (inside - epoch[likely]) / (epoch[likely + 1] - epoch[likely])
    assert abs(place.mean() - 0.5) < 4.5 * np.sqrt(1 / 12) / np.sqrt(ess * p[likely] / 4)
