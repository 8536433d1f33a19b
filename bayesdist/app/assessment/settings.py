"""Settings of an assessment: at which date, on which grid, with which random numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.assess import Requirement
from bayesdist.assess.evaluation import EvaluationSettings

ASSESSMENT = 2  # of the random streams that follow from the one seed; the sampler has the first


def assessment_rng(config: Config) -> np.random.Generator:
    """Random numbers of the assessment, from their beginning."""
    return np.random.default_rng([config.sampler.seed, ASSESSMENT])


def assessment_epoch(data: FitData, config: Config) -> float | None:
    """Epoch of the assessment, decimal years.

    Where none is given, the date from which a product is to be used, or the latest date of the
    stars if that is later: errors of a drift grow with time.
    """
    if config.assess.epoch is not None or data.model.time is None:
        return config.assess.epoch
    return max((data.last_epoch, *config.products.useafter_years()))


def evaluation_settings(data: FitData, config: Config) -> EvaluationSettings:
    """Where and how errors are evaluated."""
    return replace(rehearsal_settings(data, config), dates=data.dates)


def rehearsal_settings(data: FitData, config: Config) -> EvaluationSettings:
    """Settings of an evaluation, without the dates of the stars, which only verdicts name."""
    measured = data.fitted.scatter is not None or data.fitted.solved is not None
    return EvaluationSettings(
        grid=config.assess.grid,
        epoch=assessment_epoch(data, config),
        draws=config.assess.draws,
        years_ahead=config.assess.years_ahead,
        scale_mas=config.detector.scale_mas,
        single=config.assess.exposure == "single",
        # errors of centroids that the fit has found hold nothing else
        contained=() if measured else config.held_in_residuals(data.model.unit),
        given=tuple(block.name for block in config.budget if block.stated),
    )


def idle_dates(config: Config, requirements: Sequence[Requirement], where: str = "") -> str:
    """Sentence on dates that have no effect, as nothing in the model depends on time; '' for none.

    They may well document when the data are from, so that they are no error.  `where` is the file
    of the requirements, if it is not the configuration.
    """
    if config.campaign is not None or config.time() is not None:
        return ""
    named = [f"of {r.where}" for r in requirements if r.epoch is not None]
    if config.assess.epoch is not None and not where:
        named.insert(0, "assess.epoch")
    if not named:
        return ""
    file = f"{where}: " if where else ""
    return (
        f"{file}nothing in the model depends on time, so that the dates given change nothing "
        f"({', '.join(named)})"
    )
