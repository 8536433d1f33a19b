"""Four samplers on one posterior: stock emcee, DEMove on the kernel, NUTS and bayesdist."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tests.benchmarks import nuts, ours, walkers
from tests.benchmarks.agreement import compare
from tests.benchmarks.effective import Tau
from tests.benchmarks.problem import simulated
from tests.benchmarks.timing import say

__all__ = ["FULL", "QUICK", "Size", "Sizes", "run"]


@dataclass(frozen=True)
class Size:
    """Time limits in seconds for one number of stars."""

    n: int
    stock_plain: float
    stock_chain: float
    de: float
    nuts: float
    ours: float
    bases: tuple[str, ...] = ("whitened",)  # of NUTS


@dataclass(frozen=True)
class Sizes:
    """What is run."""

    order: int
    each: tuple[Size, ...]
    rows: int  # most rows of a chain of walkers
    thin: int
    nuts_warmup: int
    nuts_draws: int
    most_ess: float


FULL = Sizes(
    order=5,
    each=(
        Size(5_000, stock_plain=4, stock_chain=40, de=10, nuts=30, ours=6),
        Size(50_000, stock_plain=4, stock_chain=0, de=4, nuts=10, ours=6),
        Size(1_000_000, stock_plain=8, stock_chain=0, de=4, nuts=0, ours=15, bases=()),
    ),
    rows=5_000,
    thin=10,
    nuts_warmup=400,
    nuts_draws=1000,
    most_ess=50_000,
)

QUICK = Sizes(
    order=1,
    each=(Size(400, stock_plain=0.5, stock_chain=60, de=60, nuts=30, ours=1, bases=nuts.BASES),),
    rows=700,
    thin=5,
    nuts_warmup=300,
    nuts_draws=500,
    most_ess=3_000,
)


def run(sizes: Sizes) -> dict[str, Any]:
    """Rows of all samplers at all sizes, with ratios of what is measured in this run.

    Parameters
    ----------
    sizes : Sizes

    Returns
    -------
    dict
    """
    rows: list[dict[str, Any]] = []
    stretch: Tau | None = None
    evolution: Tau | None = None
    chains: dict[str, nuts.Chains] = {}
    for size in sizes.each:
        problem = simulated(size.n, sizes.order)
        here = []

        def done(sampler: str, row: dict[str, Any], here: list[Any] = here, n: int = size.n) -> Any:
            here.append({"sampler": sampler, "n_stars": n} | row)
            say(f"samplers: N = {n:,}, {sampler}: {row['rate']:.4g} effective draws per second")
            return row

        row, reference = ours.ours(problem, seconds=size.ours, most_ess=sizes.most_ess)
        mine = done("bayesdist", row)
        our_ess = min(mine["ess_bulk"], mine["ess_tail"])
        white = walkers.White.of(reference)

        row, stretch, draws = walkers.stock(
            problem,
            stretch,
            plain_s=size.stock_plain,
            chain_s=size.stock_chain,
            rows=sizes.rows,
            thin=sizes.thin,
        )
        if draws is not None:
            ess = row["walkers"] * len(draws) * sizes.thin / stretch.worst
            row |= {"ess": ess, "agreement": compare(draws, ess, reference, our_ess)}
        done("stock emcee", row)

        row, evolution, draws = walkers.differential_evolution(
            problem, white, evolution, seconds=size.de, rows=sizes.rows, thin=sizes.thin
        )
        ess = row["walkers"] * len(draws) * sizes.thin / evolution.worst
        row |= {"ess": ess, "agreement": compare(draws, ess, reference, our_ess)}
        done("emcee DEMove + kernel", row)

        for basis in size.bases:
            row, chains[basis], draws = nuts.nuts(
                problem,
                white,
                basis,
                chains.get(basis),
                seconds=size.nuts,
                warmup=sizes.nuts_warmup,
                draws=sizes.nuts_draws,
            )
            ess = min(row["ess_bulk"], row["ess_tail"])
            row |= {"basis": basis, "agreement": compare(draws, ess, reference, our_ess)}
            done(f"NUTS, {basis}", row)
        rows += _with_ratios(here)
    return {
        "order": sizes.order,
        "n_params": problem.dim,
        "rows": rows,
    }


def _with_ratios(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """How many times faster bayesdist is than each, sampling against sampling and all in all."""
    mine = rows[0]
    return [
        row
        | {
            "ratio": mine["rate"] / row["rate"],
            # chains of walkers are charged neither for burn-in nor for a fit
            "ratio_total": mine["rate_total"] / row.get("rate_total", row["rate"]),
        }
        for row in rows
    ]
