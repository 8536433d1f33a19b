"""Simulation-based calibration (Talts et al. 2018): truths from the prior rank uniformly.

Everything that a sweep moves is in it: trend, scatter, correlation, outliers, breaks and drifts.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chisquare

from bayesdist.infer.convergence import Limits
from bayesdist.kinds.campaign.series import Design, Series, TrendModel
from bayesdist.kinds.campaign.series.problem import WIDE, SeriesProblem
from bayesdist.kinds.campaign.series.sampler import (
    FRACTION_PRIOR,
    KAPPA_RATE,
    MAX_FRACTION,
    MIN_KAPPA,
    run,
)
from tests.infer.calibration import over_seeds
from tests.reduced import only_in_full

from .test_scatter import prior_draws

pytestmark = pytest.mark.slow

THINNED = 199
TRENDS = {
    "line": TrendModel("line"),
    "step": TrendModel("step", find=1),
    "spline": TrendModel("spline"),
}


def truncated(draw, inside) -> float:
    """The first draw that lies inside."""
    while not inside(value := float(draw())):
        pass
    return value


def ranks_of(name: str, seed: int) -> dict[str, float]:
    """Rank of each true value among thinned posterior draws."""
    rng = np.random.default_rng([83, seed, len(name)])
    n, k, trend = 24, 2, TRENDS[name]
    epoch = np.sort(rng.uniform(2002, 2014, n))
    dummy = Series.of(epoch, rng.standard_normal((n, k)), coefficients=("a", "b"))
    design = Design(trend, dummy)
    sigma = prior_draws(k, 1, rng)[0]
    fraction = truncated(lambda: rng.beta(*FRACTION_PRIOR), lambda f: f <= MAX_FRACTION)
    kappa = truncated(lambda: np.sqrt(KAPPA_RATE / rng.standard_gamma(1)), lambda v: v >= MIN_KAPPA)
    drift = np.abs(rng.standard_t(2, size=k))
    breaks = np.zeros((1, 0))
    if trend.find:
        dates = np.sort(epoch)
        breaks = np.array([[rng.uniform(dates[4], dates[-5])]])
    columns = design.matrix(epoch, dummy.group_code, breaks if trend.find else None)
    columns = columns.reshape(n, -1)
    b = WIDE * rng.standard_normal((k, columns.shape[1]))
    b[:, design.n_fixed :] = drift[:, None] * rng.standard_normal(
        (k, columns.shape[1] - design.n_fixed)
    )
    formal = np.zeros((k, k, n))
    # formal errors from none to well above the scatter
    size = np.exp(rng.normal(-1, 1.5))
    formal[range(k), range(k)] = (size * rng.uniform(0.5, 2, (k, n))) ** 2
    noise = [np.linalg.cholesky(sigma + formal[..., e]) @ rng.standard_normal(k) for e in range(n)]
    off = rng.random(n) < fraction
    y = b @ columns.T + (np.array(noise) * np.where(off, kappa, 1.0)[:, None]).T
    problem = SeriesProblem(dummy, design, y, formal, np.sqrt(formal))
    _, _, draws, convergence = run(
        problem, rng, chains=16, warmup=100, sweeps=150, most=1200, limits=Limits(400, 1.02)
    )

    def rank(values: np.ndarray, true: float) -> float:
        return float((rng.choice(values.ravel(), THINNED, replace=False) < true).sum())

    sd = np.sqrt(np.diagonal(draws.sigma, axis1=2, axis2=3))
    correlation = draws.sigma[..., 0, 1] / sd[..., 0] / sd[..., 1]
    out = {
        "converged": float(convergence.converged),
        "scatter": rank(sd[..., 0], np.sqrt(sigma[0, 0])),
        "scatter 2": rank(sd[..., 1], np.sqrt(sigma[1, 1])),
        "correlation": rank(correlation, sigma[0, 1] / np.sqrt(sigma[0, 0] * sigma[1, 1])),
        "fraction": rank(draws.fraction, fraction),
        "inflation": rank(draws.kappa2, kappa**2),
        "trend": rank(draws.b[..., 0, 1], b[0, 1]),
    }
    if trend.find:
        out["break"] = rank(draws.breaks, breaks[0, 0])
    if design.drift:
        out["drift"] = rank(draws.drift[..., 0], drift[0])
    return out


def line_ranks(seed: int) -> dict[str, float]:
    return ranks_of("line", seed)


def step_ranks(seed: int) -> dict[str, float]:
    return ranks_of("step", seed)


def spline_ranks(seed: int) -> dict[str, float]:
    return ranks_of("spline", seed)


@only_in_full("test_calibration has pulls and coverage, test_closed_forms the densities")
@pytest.mark.parametrize("function", [line_ranks, step_ranks, spline_ranks])
def test_ranks_are_uniform(function, capsys):
    ranks = over_seeds(function, 300)
    assert np.mean([r["converged"] for r in ranks]) > 0.9
    for key in ranks[0]:
        if key == "converged":
            continue
        values = np.array([r[key] for r in ranks])
        counts, _ = np.histogram(values, bins=10, range=(-0.5, THINNED + 0.5))
        p = chisquare(counts).pvalue
        with capsys.disabled():
            print(f"\n{function.__name__}, {key}: {counts}, p = {p:.3f}", end="")
        assert p > 1e-3, key
