"""bayesdist itself: from the matches to the posterior, and what the sampling alone costs."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

import bayesdist as bd
from tests.benchmarks.effective import smallest_ess
from tests.benchmarks.problem import Problem, draws_of, kernel_call
from tests.benchmarks.timing import Deadline, best

__all__ = ["ours", "seconds_per_pass"]

Float = NDArray[np.float64]

BATCH = 64  # parameter vectors of one call when the kernel's speed is measured
FIRST_ESS = 400.0
REPEATS = 3


def seconds_per_pass(problem: Problem) -> float:
    """Seconds of one exact pass at the kernel's own speed, on all threads it may use."""
    spread = np.concatenate([problem.fit.sigma, np.full(3, 0.02)])
    rng = np.random.default_rng(0)
    call = kernel_call(problem, problem.truth + spread * rng.standard_normal((BATCH, problem.dim)))
    call()
    # many short calls: a clock that starts while the threads wake would be unfair
    inner = max(1, int(2e6 / len(problem) / BATCH))
    return best(lambda: [call() for _ in range(inner)], 5) / inner / BATCH


def _run(problem: Problem, ess: float) -> tuple[bd.Posterior, float, float]:
    """Posterior, seconds of the linear fit, and seconds of fit and sampling together."""
    start = time.perf_counter()
    fit = bd.fit_linear(problem.matches, problem.model)
    fitted = time.perf_counter()
    posterior = bd.sample(fit, problem.matches, target_ess=ess, seed=1)
    return posterior, fitted - start, time.perf_counter() - start


def _repeated(run: Callable[[], tuple[bd.Posterior, float, float]], seconds: float) -> Any:
    """The posterior and median seconds of some equal runs."""
    limit, out = Deadline(seconds), []
    while len(out) < REPEATS and not (out and limit.over):
        out.append(run())
    return out[0][0], *(statistics.median(o[k] for o in out) for k in (1, 2))


def ours(problem: Problem, *, seconds: float, most_ess: float) -> tuple[dict[str, Any], Float]:
    """A run to 400 effective draws as users make it, and a longer one.

    The second goes over the same fit, search for the mode and start with the same random numbers:
    what it takes longer is sampling and nothing else.

    Parameters
    ----------
    problem : Problem
    seconds : float
        About what the sampling of the longer run should take, and the limit for each set of
        repeats.
    most_ess : float
        Largest effective sample size that is asked of it.

    Returns
    -------
    row : dict
    draws : ndarray (chains, n, D)
    """
    _run(problem, FIRST_ESS)  # compiled, and arviz imported
    first, fit_s, first_s = _repeated(lambda: _run(problem, FIRST_ESS), seconds)
    pass_s = seconds_per_pass(problem)
    fewer = min(smallest_ess(draws_of(first)))
    # the longer run must draw more, even where the first was generous
    aim = max(3 * FIRST_ESS, 2 * fewer, min(most_ess, 0.3 * seconds / pass_s))
    posterior, _, long_s = _repeated(lambda: _run(problem, aim), seconds)
    draws = draws_of(posterior)
    bulk, tail = smallest_ess(draws)
    info, found = posterior.sampler, posterior.convergence
    gained, took = min(bulk, tail) - fewer, long_s - first_s
    rate = gained / took if gained > 0 and took > 0 else float("nan")
    passes_gained = info.passes - first.sampler.passes
    flags = [] if found.converged else ["not converged"]
    row = {
        "ess_bulk": bulk,
        "ess_tail": tail,
        "seconds": long_s,
        "fit_s": fit_s,
        "to_400_s": first_s,
        "to_400_ess": fewer,
        "passes": info.passes,
        "rate": rate,
        "rate_total": min(bulk, tail) / long_s,
        "per_pass": min(bulk, tail) / info.passes,
        "per_pass_sampling": gained / passes_gained if passes_gained else float("nan"),
        "seconds_per_pass": pass_s,
        "share_of_limit": rate * pass_s,
        "share_of_limit_total": min(bulk, tail) / long_s * pass_s,
        "acceptance": info.acceptance,
        "efficiency": found.importance_efficiency,
        "setting": info.method,
        "flags": flags,
    }
    return row, draws
