"""Self-calibration against the number of detections, each in a process of its own."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.benchmarks import child
from tests.benchmarks.machine import peak_rss_mb
from tests.benchmarks.scaling import exponent
from tests.benchmarks.timing import say

if TYPE_CHECKING:
    from tests.kinds.selfcal.dithered_fields import DitheredField

__all__ = ["FULL", "QUICK", "WARM", "Sizes", "measure", "run", "simulated"]

ROLLS = (0.0, 60.0, 130.0)
SIDE = (4096.0, 4146.0)  # of both chips, with their gap
LARGEST = 0.2  # offset in parts of it: dense, as 50 detections of a star in 110 exposures ask for
WARM = (4, 400)


@dataclass(frozen=True)
class Sizes:
    """What is run."""

    order: int
    fields: tuple[tuple[int, int], ...]  # exposures, stars of the sky
    seconds: float  # limit for each


FULL = Sizes(5, ((14, 8_000), (28, 16_000), (110, 65_500)), 900)
QUICK = Sizes(2, ((4, 400),), 300)


def measure(exposures: int, stars: int, order: int) -> dict[str, Any]:
    """Simulate, calibrate and sample in this process."""
    if stars > WARM[1]:
        _calibrated(*WARM, 2)  # compiled and imported
    return _calibrated(exposures, stars, order)


def simulated(exposures: int, stars: int, order: int) -> DitheredField:
    """Field of two chips, with 5 % of false detections."""
    from bayesdist.kinds.selfcal.patterns.exposures import dither_pattern
    from bayesdist.model import Chip
    from tests.kinds.selfcal.dithered_fields import simulate_dithers, smooth_distortion

    rng = np.random.default_rng(1)
    chips = tuple(Chip(n, f"WFC{n}", (4096.0, 2048.0), (2048.0, 1024.0)) for n in (1, 2))
    return simulate_dithers(
        chips,
        smooth_distortion(order, chips, 30.0, rng),
        *dither_pattern(exposures, SIDE, ROLLS, rng, largest=LARGEST),
        n_stars=stars,
        rng=rng,
        sigma=(0.01, 0.05),
        disturbed=0.025,
        spurious=0.025,
    )


def _calibrated(exposures: int, stars: int, order: int) -> dict[str, Any]:
    from bayesdist.kinds.selfcal.infer import sample_selfcal, self_calibrate
    from bayesdist.kinds.selfcal.infer.calibrate import star_catalogue

    field = simulated(exposures, stars, order)
    detections = field.unlabelled
    clock = [time.perf_counter()]
    found = self_calibrate(
        field.model, detections, field.theta, match_radius=1.0, start_radius=2.0, min_detections=3
    )
    clock.append(time.perf_counter())
    posterior = sample_selfcal(found.mode, seed=2)
    catalogue = star_catalogue(found.mode)
    clock.append(time.perf_counter())
    solve_s, sample_s = np.diff(clock)
    return {
        "exposures": exposures,
        "stars": len(catalogue.values),
        "n_stars": len(detections),
        "solve_s": float(solve_s),
        "sample_s": float(sample_s),
        "seconds": float(clock[-1] - clock[0]),
        "peak_mb": peak_rss_mb(),
        "passes": posterior.sampler.passes,
        "converged": bool(posterior.convergence.converged),
    }


def run(sizes: Sizes) -> dict[str, Any]:
    """Seconds and peak memory of each field, and the fitted exponent.

    Parameters
    ----------
    sizes : Sizes

    Returns
    -------
    dict
    """
    rows: list[dict[str, Any]] = []
    stopped: list[int] = []
    for exposures, stars in sizes.fields:
        row = child.call(
            "dithers", "measure", sizes.seconds, exposures=exposures, stars=stars, order=sizes.order
        )
        if row is None:
            stopped.append(exposures)
            say(f"dithers: {exposures} exposures: stopped after {sizes.seconds:g} s")
            break
        rows.append(row)
        say(f"dithers: {row['n_stars']:,} detections: {row['seconds']:.3g} s")
    return {
        "order": sizes.order,
        "rows": rows,
        "stopped": stopped,
        "limit_s": sizes.seconds,
        "exponent": exponent(rows),
    }
