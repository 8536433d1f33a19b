"""Diagnostics of the solution of a run, whatever it was made from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from bayesdist.app.assessment.error_terms import errors_of_run
from bayesdist.app.assessment.holdout import predictive_of_run
from bayesdist.app.assessment.periods import period_settings
from bayesdist.app.assessment.settings import assessment_rng, evaluation_settings
from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.kind import kind_of
from bayesdist.diagnose.diagnostics import Diagnostics, diagnose, diagnose_fit, hold_out
from bayesdist.infer import Posterior


def diagnose_run(posterior: Posterior, data: FitData, config: Config, base: Path) -> Diagnostics:
    """Diagnostics of a posterior, and of the stars that were held out."""
    scatter, tables = data.fitted.scatter, data.fitted.tables.tables
    found = diagnose(
        data.fit,
        posterior,
        data.stars,
        data.shards,
        data.sample,
        rng=assessment_rng(config),
        tested=data.matched.with_motions(data.sample),
        discrepancy=config.discrepancy.priors(),
        priors=data.fitted.priors,
        match_radius=config.outliers.match_radius,
        # tables that were fitted have taken it; their errors, and what they leave between their
        # nodes, are terms of the budget
        structure=scatter is None or config.tables.method == "none",
        exposures=scatter is None,
        settling=None if scatter is None else scatter.offsets,
        catalogue=data.matched.star_errors,
        periods=period_settings(data, config),
        **_of_kind(data, config),
    )
    overlap = data.matched.overlap(posterior, tables)
    found = replace(found, overlap=overlap)
    if data.held is None:
        return found
    errors = errors_of_run(posterior, found, data, config)
    settings = evaluation_settings(data, config)
    predictive = predictive_of_run(posterior, found, errors, data, settings)
    return hold_out(found, predictive, data.held, data.matched.whole)


def diagnose_fit_of_run(data: FitData, config: Config) -> Diagnostics:
    """Diagnostics of a fit alone."""
    options = _of_kind(data, config) | {"known": data.fitted.priors.joint is not None}
    return diagnose_fit(data.fit, None, data.stars, data.shards, data.sample, **options)


def _of_kind(data: FitData, config: Config) -> dict[str, Any]:
    """Options of `diagnose_fit`: errors of centroids that the fit has found, and words."""
    rows, fitted = kind_of(config).rows, data.fitted
    options: dict[str, Any] = {"things": "pairs" if rows == "stars" else rows}
    if fitted.scatter is not None or fitted.solved is not None:
        options["centroid"] = fitted.errors.by_magnitude
    if fitted.solved is not None:
        options["eliminated"] = fitted.solved.mode
    return options
