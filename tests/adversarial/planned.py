"""Exposures that `bayesdist plan` asks for, simulated: does the run then meet the requirement?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from bayesdist.app.commands.on_runs.plan import content_of, needs_of

from . import exposure_kinds, fields, selfcal_kinds
from .measure import assessed
from .truth import Truth, mapped, observed, order_config, pixels

ASKED = 0.8  # probability of each requirement, and that the run then meets it
MOST = 100  # exposures of a truth, of which a run has some


@dataclass(frozen=True)
class Planned:
    """What a plan said, and what came of it."""

    exposures: int | None  # more that were asked for; None if none would do
    stated: float  # probability that the requirement is met with them
    met: bool  # whether it was
    probability: float  # that the run with them stated


@dataclass(frozen=True)
class PlannedKind:
    """Truths of which a run has a few exposures, and a requirement that takes more.

    Parameters
    ----------
    make : callable
        A random generator and a number of exposures to a Truth.
    exposures : int
        That a run has before the plan is made.
    limit : float
        Pixels, of p95: chosen with seeds 1 and 2, and fixed before the seeds of the test were run.
    """

    make: Callable[[np.random.Generator, int], Truth]
    exposures: int
    limit: float

    def truth(self, seed: int) -> Truth:
        """A truth with more exposures than a plan asks for."""
        return self.make(np.random.default_rng([42, seed]), MOST)

    def asking(self, truth: Truth, n: int) -> Truth:
        """The first n exposures of a truth, and the requirement."""
        names = list(dict.fromkeys(truth.stars["exposure"].tolist()))[:n]
        rows = np.isin(truth.stars["exposure"], names)
        stars = {name: column[rows] for name, column in truth.stars.items()}
        need = {"name": "r", "statistic": "p95", "limit": self.limit, "probability": ASKED}
        assess = truth.config.get("assess", {}) | {"grid": [9, 9], "draws": 1000}
        config: dict[str, Any] = truth.config | {"requirement": [need], "assess": assess}
        frames = {name: frame for name, frame in truth.frames.items() if name in names}
        return replace(truth, stars=stars, config=config, frames=frames)

    def carried_out(self, seed: int) -> Planned | None:
        """The plan of a run and the run with what it asked for; None if it is met already."""
        truth = self.truth(seed)
        with TemporaryDirectory() as folder:
            results = assessed(self.asking(truth, self.exposures), Path(folder), seed)
            [(_, [need])] = needs_of(results, content_of(results))
        if need.exposures == 0:
            return None
        n = min(need.exposures or MOST, MOST - self.exposures)
        with TemporaryDirectory() as folder:
            more = self.asking(truth, self.exposures + n)
            [row] = assessed(more, Path(folder), seed).run.summary["margins"]
        stated = need.probability
        return Planned(
            need.exposures, stated, row["probability_met"] >= ASKED, row["probability_met"]
        )


def matched(rng: np.random.Generator, n: int) -> Truth:
    """Exposures of 150 matched stars that breathe, in the mean."""
    true_map = mapped(fields.distortion(rng))
    scatter = exposure_kinds.normal_deviations
    return exposure_kinds.campaign(rng, 150 * n, true_map, exposures=n, deviations=scatter)


def single(rng: np.random.Generator, n: int) -> Truth:
    """The same, and positions are those in an exposure that is yet to come."""
    truth = matched(rng, n)
    return replace(truth, config=truth.config | {"assess": {"exposure": "single"}})


def self_calibrated(rng: np.random.Generator, n: int) -> Truth:
    """Detections of the same stars in exposures that are dithered and rolled."""
    true_map = mapped(selfcal_kinds.small_distortion(rng))
    return selfcal_kinds.dithered(rng, selfcal_kinds.IN_EXPOSURE * n, true_map)


KINDS = {
    "matched": PlannedKind(matched, exposures=6, limit=0.022),
    "single": PlannedKind(single, exposures=6, limit=0.08),
    "self-calibration": PlannedKind(self_calibrated, exposures=5, limit=0.0055),
}


def of_800_stars(rng: np.random.Generator, n: int) -> Truth:
    """Exposures of 800 matched stars of what is fitted."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, 800 * n)
    names = np.array([f"e{k:02d}" for k in range(n)])[np.arange(len(x)) % n]
    return Truth(
        observed(rng, x, y, true_map(x, y, None), exposure=names), true_map, order_config(3)
    )


# like runs for which a plan that changed the coefficients alone found no number of exposures
FEW = {
    "one exposure": PlannedKind(of_800_stars, exposures=1, limit=0.003),
    "six exposures": PlannedKind(matched, exposures=6, limit=0.025),
}
