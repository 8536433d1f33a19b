"""Series of known truth, as in Tables 1-3 of ACS ISR 2015-06."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.kinds.campaign.series import Series, TrendModel, TrendVerdict

COEFFICIENTS = ("A_2", "B_2", "B_3")
REFERENCE = (2004.5, 2012.5)
BREAK = 2009.4  # Servicing Mission 4, May 2009
# WFC1: rows before and after SM4, columns A_2 (Table 1), B_2 (Table 3), B_3 (Table 2)
ALPHA = np.array([[0.98205648, 0.080947069, 0.97263238], [0.98196909, 0.081139194, 0.97263233]])
BETA = np.array([[-9.22e-6, 3.617e-5, 2.42e-6], [-2.18e-5, 3.235e-5, -1.12e-6]])
SIGMA_ALPHA = np.array([[9.14e-7, 9.206e-7, 1.25e-6], [1.45e-6, 2.45e-6, 1.41e-6]])
SIGMA_BETA = np.array([[6.85e-7, 6.893e-7, 9.37e-7], [8.40e-7, 1.418e-6, 8.17e-7]])
# scatter of 55 exposures about a line that gives about the published formal errors
SCATTER = np.sqrt(55) * np.array([9.14e-7, 9.206e-7, 1.25e-6])
CORRELATION = np.array([[1.0, -0.3, 0.5], [-0.3, 1.0, 0.0], [0.5, 0.0, 1.0]])
FORMAL = 1.0e-6
LINES = TrendModel("lines", (BREAK,), reference=REFERENCE)


@dataclass(frozen=True, eq=False)
class Truth:
    """A simulated campaign, and which of its exposures lie off."""

    series: Series
    off: np.ndarray


def campaign(
    seed: int,
    *,
    fraction: float = 0.05,
    filters: dict[str, int] | None = None,
    beta: np.ndarray = BETA,
    slopes: dict[str, np.ndarray] | None = None,
) -> Truth:
    """110 exposures, half before and half after SM4, some of them far off.

    Parameters
    ----------
    seed : int
    fraction : float
        Of exposures that lie off, by about eight times the scatter.
    filters : dict of str to int, optional
        Number of exposures of each filter; a filter's offset grows with its place.
    beta : ndarray, shape (2, 3)
    slopes : dict of str to ndarray, shape (3,), optional
        What a filter adds to the slopes.
    """
    rng = np.random.default_rng([47, seed])
    counts = filters or {"F606W": 110}
    names = [name for name, n in counts.items() for _ in range(n)]
    n = len(names)
    early = rng.permutation(n) < n // 2
    epoch = np.where(early, rng.uniform(2002.3, 2007.0, n), rng.uniform(2009.5, 2014.5, n))
    segment = (~early).astype(int)
    values = ALPHA[segment] + beta[segment] * (epoch - np.array(REFERENCE)[segment])[:, None]
    place = np.array([list(counts).index(name) for name in names])
    values += 3e-5 * place[:, None]
    for i, name in enumerate(names):
        values[i] += (slopes or {}).get(name, np.zeros(3)) * (epoch[i] - 2008.0)
    cov = SCATTER[:, None] * CORRELATION * SCATTER
    values += rng.multivariate_normal(np.zeros(3), cov, n)
    formal = FORMAL * rng.uniform(0.5, 2.0, (n, 3))
    values += formal * rng.standard_normal((n, 3))
    off = rng.random(n) < fraction
    values[off] += 8 * SCATTER * rng.standard_normal((off.sum(), 3))
    group = tuple(names) if filters else ()
    return Truth(Series.of(epoch, values, formal, coefficients=COEFFICIENTS, group=group), off)


def drifting(seed: int, n: int = 80, memory: float = 0.7, k: int = 2) -> Series:
    """No trend at all, but deviations that successive exposures share (first-order process)."""
    rng = np.random.default_rng([48, seed])
    epoch = 2013 + np.sort(rng.uniform(0, 6, n))
    noise = rng.standard_normal((n, k))
    values = np.empty((n, k))
    values[0] = noise[0]
    for i in range(1, n):
        values[i] = memory * values[i - 1] + np.sqrt(1 - memory**2) * noise[i]
    return Series.of(epoch, values, 0.03, coefficients=tuple("abcdef"[:k]))


def is_line(verdict: TrendVerdict) -> bool:
    """True if a drift is claimed that goes on."""
    trend = verdict.posterior.trend
    return trend.has_slope and trend.kind != "spline"
