"""Requirements near the limit: what probability is said, and whether they are met in truth."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bayesdist.app.evaluating import margins_of_run
from bayesdist.assess import Margin, Requirement
from bayesdist.assess.budget_surface import JOINT as MODEL
from bayesdist.assess.domain import field_statistic
from bayesdist.model.grid import grid_pixels, mesh

from .campaigns import BEYOND, EXPOSURES, KINDS, OFFSET, assessed, campaign
from .places import model_errors, one_thread

STATISTICS = ("rms", "p95", "max")
PILOTS = 1_000_000  # seeds of campaigns that only set the limits
KEPT = 250  # draws of each
SPREAD = 0.2  # of the logarithm of limits: a few errors of a pattern's measured size


def _judged(name: str, seed: int, limits: dict[str, float]) -> tuple[list[Margin], dict]:
    """Margins, and the statistics of the true error field."""
    kind = KINDS[name]
    requirements = tuple(
        # a probability that nearly all reach: what would help is not asked for
        Requirement(statistic, statistic, limit, probability=0.001)
        for statistic, limit in limits.items()
    )
    with TemporaryDirectory() as folder, one_thread():
        truth = campaign(kind, seed)
        with closing(assessed(kind, seed, truth.stars, Path(folder))) as results:
            margins = margins_of_run(results, requirements)
            solution, grid = results.solution, results.config.assess.grid
    model, rng = solution.model, truth.rng
    x, y = mesh(*grid_pixels(model.chips[0].size, grid))
    epoch = np.full(x.size, BEYOND) if kind.drift else None
    exposure = np.full(x.size, rng.integers(1, EXPOSURES) if kind.drift else 0)
    error = model_errors(truth, model, np.asarray(solution.mean), x, y, epoch, exposure)[MODEL]
    error = error - truth.pattern(x, y) + OFFSET * rng.standard_normal(2)
    return list(margins), {s: float(field_statistic(s, error)) for s in limits}


def pilot(name: str, seed: int) -> dict[str, np.ndarray]:
    """What is said of each statistic of a campaign that is not judged."""
    margins, _ = _judged(name, PILOTS + seed, dict.fromkeys(STATISTICS, 1.0))
    return {m.requirement.statistic: m.draws[:KEPT] for m in margins}


def limits_from(name: str, pilots: list[dict[str, np.ndarray]], n: int) -> list[tuple[str, float]]:
    """A statistic and a limit for each of n campaigns, near what the pilots' errors are.

    Half of the limits are met by 75 to 98 % of the pilots' draws, the others by 3 to 97 %.  Where
    there is a pattern they are even in the logarithm.
    """
    rng = np.random.default_rng(2012)
    out = []
    for k in range(n):
        statistic = STATISTICS[k % len(STATISTICS)]
        drawn = np.array([p[statistic] for p in pilots])
        if KINDS[name].pattern:
            limit = np.median(drawn) * np.exp(rng.uniform(-SPREAD, SPREAD))
        else:
            share = rng.uniform(0.75, 0.98) if k % 2 else rng.uniform(0.03, 0.97)
            limit = np.quantile(drawn, share)
        out.append((statistic, float(limit)))
    return out


def said_and_true(name: str, limit: tuple[str, float], seed: int) -> tuple[float, bool]:
    """The probability with which a campaign is said to meet a limit, and whether it does."""
    statistic, value = limit
    [margin], true = _judged(name, seed, {statistic: value})
    return margin.probability_met, true[statistic] <= value
