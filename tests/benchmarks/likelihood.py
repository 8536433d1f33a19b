"""The likelihood kernel against numpy and against the roofline."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.benchmarks import roofline
from tests.benchmarks.plain import PlainDensity
from tests.benchmarks.problem import Threads, kernel_call, simulated
from tests.benchmarks.timing import best, say

__all__ = ["FULL", "QUICK", "Sizes", "run"]

SPREAD = 0.001  # of the parameter vectors of a batch about the truth: all near the posterior


@dataclass(frozen=True)
class Sizes:
    """What is run."""

    orders: tuple[int, ...]
    stars: tuple[int, ...]
    batch: int
    threads: tuple[int, ...]
    design_mb: float  # numpy is left out where its design matrix would be larger
    work: float  # star evaluations of one timed call, at least
    rounds: int
    quick: bool = False


FULL = Sizes(
    orders=(1, 3, 5, 7, 9),
    stars=(5_000, 50_000, 1_000_000),
    batch=32,
    threads=(1, 2),
    design_mb=250,
    work=1e7,
    rounds=2,
)
QUICK = Sizes((1, 3), (400,), 16, (1, 2), 10, 1e4, 1, quick=True)


def run(sizes: Sizes) -> dict[str, Any]:
    """Nanoseconds for one star and evaluation.

    Parameters
    ----------
    sizes : Sizes

    Returns
    -------
    dict
    """
    ceiling = roofline.measure(quick=sizes.quick)
    found: dict[tuple[int, int], dict[str, float]] = {}
    # speed of the processor changes from minute to minute: the best is what it can do
    for _ in range(sizes.rounds):
        for order in sizes.orders:
            ceiling = ceiling.or_better(roofline.measure(quick=sizes.quick))
            for n in sizes.stars:
                took, before = _nanoseconds(order, n, sizes), found.get((order, n), {})
                found[order, n] = {k: min(t, before.get(k, t)) for k, t in took.items()}
                say(f"kernel: order {order}, N = {n:,}: {took['ns_1']:.2f} ns per star")
    rows = [
        {"order": order, "n_stars": n, "batch": sizes.batch, **took}
        for (order, n), took in found.items()
    ]
    for row in rows:
        for count in sizes.threads:
            if f"ns_{count}" in row:
                floor = ceiling.floor_ns(row["order"], sizes.batch, count)
                row |= {f"floor_{count}": max(floor.values()), f"ceilings_{count}": floor}
    return {"roofline": ceiling.to_dict(), "mixture_ops": roofline.MIXTURE_OPS, "rows": rows}


def _nanoseconds(order: int, n: int, sizes: Sizes) -> dict[str, float]:
    """Nanoseconds for one star: of an evaluation by threads, of numpy's, and of an expansion.

    `ns_rho` is that of an evaluation by one thread with errors correlated between u and v.
    """
    problem = simulated(n, order)
    spread = np.random.default_rng(0).standard_normal((sizes.batch, problem.dim))
    psi = problem.truth + SPREAD * spread
    call, found = kernel_call(problem, psi), dict[str, float]()

    def timed(name: str, function: Callable[[], object], evaluations: float) -> None:
        function()
        inner = max(1, round(sizes.work / n / evaluations))
        took = best(lambda: [function() for _ in range(inner)])
        found[name] = took / inner / n * 1e9

    for wanted in sizes.threads:
        with Threads(wanted) as count:
            if count == wanted:  # a machine may have fewer cores
                timed(f"ns_{count}", call, sizes.batch)
                found[f"ns_{count}"] /= sizes.batch
    with Threads(1):
        timed("ns_rho", kernel_call(problem.with_correlations, psi), sizes.batch)
        found["ns_rho"] /= sizes.batch
        timed("ns_expansion", lambda: problem.target.expand(psi[0]), 10)
    if 8e-6 * n * (order + 1) ** 2 <= sizes.design_mb:
        plain = PlainDensity(problem)
        timed("ns_numpy", lambda: plain(psi[0]), 10)
    return found
