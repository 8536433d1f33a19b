"""Diagnostics of the solution of a run, whatever it was made from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bayesdist.app.assessment.error_terms import errors_of_run
from bayesdist.app.assessment.holdout import predictive_of_run
from bayesdist.app.assessment.periods import period_settings
from bayesdist.app.assessment.settings import assessment_rng, evaluation_settings
from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.kind import kind_of
from bayesdist.diagnose.diagnostics import Diagnostics, diagnose, diagnose_fit
from bayesdist.diagnose.holdout.validation import holdout_validation
from bayesdist.infer import Posterior


def diagnose_run(posterior: Posterior, data: FitData, config: Config, base: Path) -> Diagnostics:
    """Diagnostics of a posterior, and of the stars that were held out."""
    fitted = data.fitted
    scatter, tables = fitted.scatter, fitted.tables.tables
    found = diagnose(
        diagnose_residuals(posterior, data, config),
        data.fit,
        posterior,
        data.stars,
        data.shards,
        rng=assessment_rng(config),
        tested=data.matched.with_motions(data.sample),
        discrepancy=config.discrepancy.priors(),
        priors=fitted.priors,
        match_radius=config.outliers.match_radius,
        # tables that were fitted have taken it; their errors, and what they leave between their
        # nodes, are terms of the budget
        structure=scatter is None or config.tables.method == "none",
        exposures=scatter is None,
        settling=None if scatter is None else scatter.offsets,
        catalogue=data.matched.star_errors,
        eliminated=None if fitted.solved is None else fitted.solved.mode,
        periods=period_settings(data, config),
    )
    found = replace(found, overlap=data.matched.overlap(posterior, tables))
    if data.held is None:
        return found
    errors = errors_of_run(posterior, found, data, config)
    settings = evaluation_settings(data, config)
    predictive = predictive_of_run(posterior, found, errors, data, settings)
    held = holdout_validation(predictive, data.held, whole=data.matched.whole)
    return replace(found, holdout=held)


def diagnose_residuals(posterior: Posterior | None, data: FitData, config: Config) -> Diagnostics:
    """Diagnostics by residuals, of a posterior or of a fit alone."""
    fitted, rows = data.fitted, kind_of(config).rows
    # errors of centroids that the fit has found
    measured = fitted.scatter is not None or fitted.solved is not None
    return diagnose_fit(
        data.fit,
        posterior,
        data.stars,
        data.shards,
        data.sample,
        eliminated=None if fitted.solved is None else fitted.solved.mode,
        centroid=fitted.errors.by_magnitude if measured else "residuals",
        things="pairs" if rows == "stars" else rows,
        known=fitted.priors.joint is not None,
    )
