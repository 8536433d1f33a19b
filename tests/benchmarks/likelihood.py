"""The likelihood kernel against numpy and against the roofline."""

from __future__ import annotations

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
    quick: bool = False


FULL = Sizes(
    orders=(1, 3, 5, 7, 9),
    stars=(5_000, 50_000, 1_000_000),
    batch=32,
    threads=(1, 2),
    design_mb=250,
    work=1e7,
)
QUICK = Sizes((1, 3), (400,), 16, (1, 2), 10, 1e4, quick=True)


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
    rows: list[dict[str, Any]] = []
    for order in sizes.orders:
        # speed of the processor changes from minute to minute: the best is what it can do
        ceiling = ceiling.or_better(roofline.measure(quick=sizes.quick))
        for n in sizes.stars:
            problem = simulated(n, order)
            rng = np.random.default_rng(0)
            psi = problem.truth + SPREAD * rng.standard_normal((sizes.batch, problem.dim))
            call = kernel_call(problem, psi)
            row: dict[str, Any] = {"order": order, "n_stars": n, "batch": sizes.batch}
            for wanted in sizes.threads:
                with Threads(wanted) as count:
                    if count != wanted:
                        continue  # a machine with fewer cores
                    call()
                    inner = max(1, round(sizes.work / n / sizes.batch))
                    took = best(lambda call=call, k=inner: [call() for _ in range(k)])
                    row[f"ns_{count}"] = took / inner / n / sizes.batch * 1e9
            terms = (order + 1) * (order + 2) // 2
            if 8e-6 * n * (order + 1) ** 2 <= sizes.design_mb:
                plain = PlainDensity(problem)
                plain(psi[0])
                inner = max(1, round(0.1 * sizes.work / n))
                took = best(lambda plain=plain, k=inner, p=psi[0]: [plain(p) for _ in range(k)])
                row["ns_numpy"] = took / inner / n * 1e9
            row["terms"] = terms
            rows.append(row)
            one = row[f"ns_{sizes.threads[0]}"]
            say(f"kernel: order {order}, N = {n:,}: {one:.2f} ns per star and evaluation")
    for row in rows:
        for count in sizes.threads:
            if f"ns_{count}" in row:
                floor = ceiling.floor_ns(row["order"], sizes.batch, count)
                row |= {f"floor_{count}": max(floor.values()), f"ceilings_{count}": floor}
    return {"roofline": ceiling.to_dict(), "mixture_ops": roofline.MIXTURE_OPS, "rows": rows}
