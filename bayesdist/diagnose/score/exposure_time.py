"""Test whether deviations of exposures are correlated in time, beyond the drift and a parabola."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from bayesdist.diagnose.correlated.exposure_time import correlation_p, fitted_deviations
from bayesdist.diagnose.score.projection import Projection
from bayesdist.diagnose.score.result import POWER, Family, Outcome, outcome
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.utils.arrays import Float
from bayesdist.utils.distributions import norm_isf

EXPOSURES_IN_TIME = Family(
    "exposures in time",
    "judge dates among those of the exposures, or add exposures at dates between and beyond them",
    "deviations of exposures are correlated in time",
    "deviations of exposures are not correlated in time",
    held_by="time",
)


def exposure_time_test(
    projection: Projection, estimates: Mapping[int, Float], theta: Float, priors: GaussianPriors
) -> Outcome | None:
    """Test of the deviations of exposures; None without a drift, and for too few dates.

    `estimates` are the linear deviations of exposures that are not parameters, by exposure code.
    Deviations that are parameters, with `priors` on their size, are taken from the solution
    `theta`.
    """
    sample = projection.sample
    model, time = sample.model, sample.model.time
    if time is None or sample.epoch is None:
        return None
    values = fitted_deviations(model, theta, priors)
    if values is not None:
        names, first = np.unique(
            [block.frame_exposure for block in sample.blocks], return_index=True
        )
        dates = np.array([sample.epoch[sample.blocks[k].rows.start] for k in first])
        values = values[names]
    elif estimates:
        codes, first = np.unique([block.exposure for block in sample.blocks], return_index=True)
        by_code = {
            int(code): sample.epoch[sample.blocks[k].rows.start]
            for code, k in zip(codes, first, strict=True)
        }
        dates = np.array([by_code[code] for code in estimates])
        values = np.stack(list(estimates.values()))
    else:
        return None
    p, correlation = correlation_p(values, dates, time.breaks)
    if correlation == 0.0:
        return None
    rms = float(np.sqrt(np.mean((values - values.mean(axis=0)) ** 2)))
    rms *= model.pixel_size(theta) * max(max(chip.size) for chip in model.chips) / 2
    family = EXPOSURES_IN_TIME
    return outcome(
        replace(family, present=f"{family.present} ({correlation:.2f} between successive ones)"),
        correlation,
        1.0,
        None,
        p,
        square=max(correlation, 0.0) * rms**2,
        noise=0.0,
        unit=model.unit,
        smallest=partial(_smallest, rms, values.size),
    )


def _smallest(rms: float, n: int, level: float) -> float:
    """Rms of the correlated part of n deviations that is detected with the power `POWER`."""
    needed = (norm_isf(level) - norm_isf(POWER)) / np.sqrt(n)
    return float(rms * np.sqrt(min(needed, 1.0)))
