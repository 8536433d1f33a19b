"""What claims 68 % covers 68 %, with the outliers in; clipped least squares is shown beside it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, binomtest, chisquare

from tests.infer.calibration import LEVELS, coverage_of, over_seeds, ranks_of
from tests.reduced import only_in_full

pytestmark = pytest.mark.slow

CONFIDENCE = 0.99


def _band(level: float, n: int, tests: int = 1) -> tuple[float, float]:
    """Binomial band of a coverage that holds in all of so many tests with 99 % probability."""
    tail = (1 - CONFIDENCE) / 2 / tests
    low, high = binom.ppf([tail, 1 - tail], n, level)
    return low / n, high / n


@pytest.fixture(scope="module")
def runs(full: bool) -> list[dict[str, np.ndarray]]:
    return over_seeds(coverage_of, 200 if full else 24)


@only_in_full("tests/coverage has ranks of the same parameters")
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("what", ["coefficients", "positions"])
def test_intervals_cover(runs, level, what, capsys):
    assert np.mean([r["converged"] for r in runs]) == 1.0
    covered = np.array([r[f"posterior {what} {level}"].ravel() for r in runs])
    clipped = np.array([r[f"clipped {what} {level}"].ravel() for r in runs])
    n, tests = covered.shape
    each = covered.mean(axis=0)
    plain = _band(level, n)
    outside = int(((each < plain[0]) | (each > plain[1])).sum())
    with capsys.disabled():
        print(
            f"\n{what}, {level:.1%}: posterior {covered.mean():.4f} "
            f"({each.min():.3f} to {each.max():.3f}; {outside} of {tests} outside the 99 % band "
            f"{plain[0]:.3f} to {plain[1]:.3f}), clipped least squares {clipped.mean():.4f}, "
            f"{n} truths"
        )
    low, high = _band(level, n, tests)
    assert (each >= low).all() and (each <= high).all()
    # no more of them outside the plain band than chance allows
    chance = 1 - (binom.cdf(plain[1] * n, n, level) - binom.cdf(plain[0] * n - 1, n, level))
    assert binomtest(outside, tests, max(chance, 1e-9), "greater").pvalue > 0.001


def test_clipped_least_squares_is_overconfident(runs):
    """Why the posterior is worth its price: clipping leaves outliers and ignores the jitter."""
    clipped = np.array([r["clipped coefficients 0.683"].ravel() for r in runs])
    posterior = np.array([r["posterior coefficients 0.683"].ravel() for r in runs])
    assert clipped.mean() < _band(0.683, clipped.size)[0]
    assert clipped.mean() < posterior.mean()


@only_in_full("tests/coverage has ranks of the same parameters")
def test_ranks_are_uniform(capsys):
    """Simulation-based calibration (Talts et al. 2018): truths from the prior rank uniformly."""
    n = 200
    ranks = over_seeds(ranks_of, n)
    assert sum(r["converged"] for r in ranks) >= 0.99 * n
    for key in ("f", "j", "s_out"):
        values = np.array([r[key] for r in ranks])
        counts, _ = np.histogram(values, bins=10, range=(-0.5, 199.5))
        p = chisquare(counts).pvalue
        with capsys.disabled():
            print(f"\nranks of {key}: {counts.tolist()}, chi-square p = {p:.3f}")
        assert p > 0.001
