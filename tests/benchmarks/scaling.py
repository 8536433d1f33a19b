"""Cost against the number of stars, each in a process of its own."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

import bayesdist as bd
from tests.benchmarks import child
from tests.benchmarks.machine import peak_rss_mb
from tests.benchmarks.problem import draws_of, open_stored, simulated, store
from tests.benchmarks.timing import say

__all__ = ["FULL", "QUICK", "Sizes", "measure", "run"]

WARM = 2_000  # stars on which everything is compiled and imported before the clock starts


@dataclass(frozen=True)
class Sizes:
    """What is run."""

    order: int
    stars: tuple[int, ...]
    seconds: float  # limit for each


FULL = Sizes(order=5, stars=(100_000, 316_000, 1_000_000, 10_000_000), seconds=240)
QUICK = Sizes(order=1, stars=(400, 1_200), seconds=60)


def measure(folder: str, order: int) -> dict[str, Any]:
    """Read, fit and sample the stored matches in this process."""
    from tests.benchmarks.effective import smallest_ess

    warm = simulated(WARM, order)
    bd.sample(warm.fit, warm.matches, target_ess=400)
    empty = peak_rss_mb()
    clock = [time.perf_counter()]
    problem = open_stored(Path(folder), order)
    clock.append(time.perf_counter())
    fit = bd.fit_linear(problem.matches, problem.model)
    clock.append(time.perf_counter())
    posterior = bd.sample(fit, problem.matches, target_ess=400)
    clock.append(time.perf_counter())
    read_s, fit_s, sample_s = np.diff(clock)
    return {
        "n_stars": len(problem),
        "read_s": read_s,
        "fit_s": fit_s,
        "sample_s": sample_s,
        "seconds": fit_s + sample_s,
        "peak_mb": peak_rss_mb(),
        "peak_before_mb": empty,
        "passes": posterior.sampler.passes,
        "ess": min(smallest_ess(draws_of(posterior))),
        "converged": posterior.convergence.converged,
    }


def exponent(rows: list[dict[str, Any]]) -> dict[str, float] | None:
    """Slope of log seconds against log N with its standard error; None for fewer than three."""
    if len(rows) < 3:
        return None
    n, s = (np.log10([row[key] for row in rows]) for key in ("n_stars", "seconds"))
    line = stats.linregress(n, s)
    return {
        "value": float(line.slope),
        "error": float(line.stderr),
        "intercept": float(line.intercept),
        "from": min(row["n_stars"] for row in rows),
        "to": max(row["n_stars"] for row in rows),
    }


def run(sizes: Sizes) -> dict[str, Any]:
    """Seconds and peak memory for each number of stars, and the fitted exponent.

    Parameters
    ----------
    sizes : Sizes

    Returns
    -------
    dict
    """
    rows: list[dict[str, Any]] = []
    stopped: list[int] = []
    for n in sizes.stars:
        with tempfile.TemporaryDirectory() as folder:
            store(Path(folder), n, sizes.order)
            row = child.call("scaling", "measure", sizes.seconds, folder=folder, order=sizes.order)
        if row is None:
            stopped.append(n)
            say(f"scaling: N = {n:,}: stopped after {sizes.seconds:g} s")
            break  # more stars would take longer
        rows.append(row)
        say(f"scaling: N = {n:,}: {row['seconds']:.3g} s, {row['peak_mb']:.0f} MB")
    return {
        "order": sizes.order,
        "rows": rows,
        "stopped": stopped,
        "limit_s": sizes.seconds,
        "exponent": exponent(rows),
    }
