"""Self-calibration on worker processes of this machine: grouping, solution and sampling apart."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from tests.benchmarks import child
from tests.benchmarks.dithers import WARM, simulated
from tests.benchmarks.machine import peak_rss_mb
from tests.benchmarks.timing import say

__all__ = ["FULL", "QUICK", "STAGES", "Sizes", "measure", "run"]

STAGES = ("group", "solve", "sample")
MATCH = 1.0  # pixels


@dataclass(frozen=True)
class Sizes:
    """What is run."""

    workers: tuple[int, ...]  # 0: without a cluster
    exposures: int
    stars: int
    order: int
    piece: int  # detections of a piece, and of a cell of the sky
    seconds: float  # limit for each


FULL = Sizes((0, 1, 2, 4), 28, 16_000, 5, 2**14, 900)
QUICK = Sizes((0, 2), 4, 400, 2, 2**9, 300)


def measure(workers: int, exposures: int, stars: int, order: int, piece: int) -> dict[str, Any]:
    """Group, solve and sample, with so many workers."""
    from bayesdist.infer import Compute
    from bayesdist.kinds.selfcal import grouping as friends
    from bayesdist.kinds.selfcal.infer import elimination

    elimination.PIECE = friends.CELL = piece
    compute = Compute(engine="dask", workers=workers) if workers else None
    with ExitStack() as stack:
        shared = stack.enter_context(elimination.one_cluster(compute))
        client = None
        if shared is not None:
            from distributed import Client

            client = stack.enter_context(Client(shared.scheduler, set_as_default=False))
            client.wait_for_workers(workers)
        if stars > WARM[1]:
            _stages(shared, client, *WARM, 2)  # compiled and imported
        return {"workers": workers, **_stages(shared, client, exposures, stars, order)}


def _stages(compute: Any, client: Any, exposures: int, stars: int, order: int) -> dict[str, Any]:
    from bayesdist.infer.equations.priors import Prior
    from bayesdist.kinds.selfcal.grouping import friends_of_friends
    from bayesdist.kinds.selfcal.infer import sample_selfcal
    from bayesdist.kinds.selfcal.infer.elimination import each_of
    from bayesdist.kinds.selfcal.infer.mode import solve_in_gauge
    from bayesdist.kinds.selfcal.infer.problem import places_of, prepare

    field = simulated(exposures, stars, order)
    model, detections, theta = field.model, field.unlabelled, field.theta
    clock = [_clock(client)]
    places = places_of(model, detections, theta)
    each = partial(each_of, compute)
    found = friends_of_friends(
        places, detections.exposure, MATCH * model.pixel_size(theta), each=each
    )
    clock.append(_clock(client))
    labelled = replace(detections, star=found.star)
    problem = prepare(model, labelled, theta, match_radius=MATCH, min_detections=3)
    mode = solve_in_gauge(problem, theta, Prior.none, compute=compute)
    clock.append(_clock(client))
    posterior = sample_selfcal(mode, seed=2, compute=compute)
    clock.append(_clock(client))
    times = zip(STAGES, np.diff(clock, axis=0).tolist(), strict=True)
    peak = 0.0 if client is None else sum(client.run(peak_rss_mb).values())
    return {
        "exposures": exposures,
        "n_stars": len(detections),
        "n_params": model.n_params,
        "passes": posterior.sampler.passes,
        "peak_mb": peak_rss_mb(),
        "workers_peak_mb": peak,
        # seconds by the clock, of the processor here, of the processor on all workers
        **{
            name: dict(zip(("s", "client_s", "workers_s"), row, strict=True)) for name, row in times
        },
    }


def _clock(client: Any) -> tuple[float, float, float]:
    of_workers = 0.0 if client is None else sum(client.run(time.process_time).values())
    return time.perf_counter(), time.process_time(), of_workers


def run(sizes: Sizes) -> dict[str, Any]:
    """Seconds and memory of each stage, by number of workers.

    Parameters
    ----------
    sizes : Sizes

    Returns
    -------
    dict
    """
    rows: list[dict[str, Any]] = []
    stopped: list[int] = []
    for workers in sizes.workers:
        row = child.call(
            "processes",
            "measure",
            sizes.seconds,
            workers=workers,
            exposures=sizes.exposures,
            stars=sizes.stars,
            order=sizes.order,
            piece=sizes.piece,
        )
        if row is None:
            stopped.append(workers)
            say(f"processes: {workers} workers: stopped after {sizes.seconds:g} s")
            continue
        rows.append(row)
        say(f"processes: {workers} workers: {sum(row[name]['s'] for name in STAGES):.3g} s")
    return {
        "order": sizes.order,
        "piece": sizes.piece,
        "rows": rows,
        "stopped": stopped,
        "limit_s": sizes.seconds,
    }
