"""Exposures that `bayesdist plan` asks for, simulated: does the run then meet the requirement?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from bayesdist.app.commands.plan import content_of, futures_of, schedules_of
from bayesdist.app.evaluating import margins_of_run
from bayesdist.app.run import Run
from bayesdist.assess import Requirement
from bayesdist.assess.planning import exposures_needed

from . import exposure_kinds, fields, selfcal_kinds
from .exposure_kinds import Scatter
from .measure import assessed
from .truth import Truth, mapped, observed, order_config, pixels

ASKED = 0.8  # probability of each requirement, and that the run then meets it
MOST = 64  # further exposures that are simulated: a number for which plans state a probability


@dataclass(frozen=True)
class Planned:
    """What a plan said, and what came of it."""

    exposures: int | None  # more that were asked for; None if none would do
    simulated: int
    stated: float  # probability that the requirement is met with those simulated
    met: bool  # whether it was
    # probability that was stated of a value no larger than the one that was reached: the rank of
    # the truth among those that were possible
    rank: float


@dataclass(frozen=True)
class PlannedKind:
    """Truths of which a run has a few exposures, and a requirement that takes more.

    Parameters
    ----------
    make : callable
        A random generator and a number of exposures to a Truth, whose scatter of exposures and
        structure are drawn anew for each.
    exposures : int
        That a run has before the plan is made.
    factor : float
        Limit of p95, relative to the one that is met at present.
    """

    make: Callable[[np.random.Generator, int], Truth]
    exposures: int
    factor: float

    def truth(self, seed: int) -> Truth:
        """A truth with more exposures than a plan asks for."""
        return self.make(np.random.default_rng([42, seed]), self.exposures + MOST)

    def carried_out(self, seed: int) -> Planned:
        """The plan of a run and the run with what it asked for."""
        truth = self.truth(seed)
        with TemporaryDirectory() as folder:
            results = assessed(first_exposures(truth, self.exposures), Path(folder), seed)
            requirement = Requirement("r", "p95", self.factor * reached(results), probability=ASKED)
            content = content_of(results)
            [schedule] = schedules_of(results, requirement, content)
            futures = futures_of(results, content)
            probability = futures(requirement).probability(schedule)
            [need] = exposures_needed([schedule], lambda _: probability, ASKED, now=0.0)
            n = MOST if need.exposures is None else min(need.exposures, MOST)
            stated = need.by_number[n]
            with TemporaryDirectory() as other:
                more = first_exposures(truth, self.exposures + n)
                value = reached(assessed(more, Path(other), seed))
            rank = futures(replace(requirement, limit=value)).probability(schedule)(n)
        return Planned(need.exposures, n, stated, value <= requirement.limit, rank)


def first_exposures(truth: Truth, n: int, **requirement: Any) -> Truth:
    """The first n exposures of a truth, and a requirement on p95."""
    names = list(dict.fromkeys(truth.stars["exposure"].tolist()))[:n]
    rows = np.isin(truth.stars["exposure"], names)
    stars = {name: column[rows] for name, column in truth.stars.items()}
    assess = truth.config.get("assess", {}) | {"grid": [9, 9], "draws": 1000}
    config: dict[str, Any] = truth.config | {"assess": assess}
    if requirement:
        config["requirement"] = [
            {"name": "r", "statistic": "p95", "probability": ASKED} | requirement
        ]
    frames = {name: frame for name, frame in truth.frames.items() if name in names}
    return replace(truth, stars=stars, config=config, frames=frames)


def reached(results: Run) -> float:
    """Limit of p95 that is met with the probability asked for, in pixels."""
    [margin] = margins_of_run(results, (Requirement("r", "p95", 1.0, probability=ASKED),))
    return float(np.quantile(margin.draws, ASKED))


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number with a logarithm that is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def scattering(size: float) -> Scatter:
    """Scale and shears of exposures that scatter by so much."""
    return lambda rng, n: size * rng.standard_normal((n, 3))


def structure(rng: np.random.Generator, low: float, high: float) -> fields.Field:
    """A smooth field with an rms between these limits, and 200 to 800 pixels long."""
    return fields.smooth(rng, log_uniform(rng, 200, 800), log_uniform(rng, low, high))


def matched(rng: np.random.Generator, n: int) -> Truth:
    """Exposures of 150 matched stars that breathe, in the mean."""
    true_map = mapped(fields.distortion(rng), structure(rng, 1e-4, 3e-3))
    scatter = scattering(log_uniform(rng, 5e-6, 8e-5))
    return exposure_kinds.campaign(rng, 150 * n, true_map, exposures=n, deviations=scatter)


def single(rng: np.random.Generator, n: int) -> Truth:
    """The same, and positions are those in an exposure that is yet to come."""
    truth = matched(rng, n)
    return replace(truth, config=truth.config | {"assess": {"exposure": "single"}})


def self_calibrated(rng: np.random.Generator, n: int) -> Truth:
    """Detections of the same stars in exposures that are dithered and rolled, and breathe.

    They are in random order: the later ones are dithered as the first ones are.
    """
    true_map = mapped(selfcal_kinds.small_distortion(rng), structure(rng, 1e-4, 2e-3))
    scatter = scattering(log_uniform(rng, 3e-7, 1e-5))
    n_detections = selfcal_kinds.IN_EXPOSURE * n
    truth = selfcal_kinds.dithered(rng, n_detections, true_map, deviations=scatter)
    names = rng.permutation(list(truth.frames)).tolist()
    rows = np.concatenate([np.flatnonzero(truth.stars["exposure"] == name) for name in names])
    stars = {name: column[rows] for name, column in truth.stars.items()}
    return replace(truth, stars=stars, frames={name: truth.frames[name] for name in names})


KINDS = {
    "matched": PlannedKind(matched, exposures=6, factor=0.6),
    "single": PlannedKind(single, exposures=6, factor=0.9),
    "self-calibration": PlannedKind(self_calibrated, exposures=5, factor=0.6),
}


@dataclass(frozen=True)
class FewExposures:
    """A truth of which a run has too few exposures for a limit of p95, in pixels."""

    make: Callable[[np.random.Generator, int], Truth]
    exposures: int
    limit: float


def of_800_stars(rng: np.random.Generator, n: int) -> Truth:
    """Exposures of 800 matched stars of what is fitted."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, 800 * n)
    names = np.array([f"e{k:02d}" for k in range(n)])[np.arange(len(x)) % n]
    return Truth(
        observed(rng, x, y, true_map(x, y, None), exposure=names), true_map, order_config(3)
    )


def breathing(rng: np.random.Generator, n: int) -> Truth:
    """Exposures of 150 matched stars that breathe."""
    true_map = mapped(fields.distortion(rng))
    scatter = exposure_kinds.normal_deviations
    return exposure_kinds.campaign(rng, 150 * n, true_map, exposures=n, deviations=scatter)


# like runs for which a plan that changed the coefficients alone found no number of exposures
FEW = {
    "one exposure": FewExposures(of_800_stars, exposures=1, limit=0.003),
    "six exposures": FewExposures(breathing, exposures=6, limit=0.025),
}
