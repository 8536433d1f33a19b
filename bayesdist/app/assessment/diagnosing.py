"""Diagnostics of the solution of a run, including held-out stars."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.assessment.error_terms import assessment_rng, errors_of_run, evaluation_settings
from bayesdist.app.assessment.periods import period_settings
from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.kind import kind_of
from bayesdist.app.kinds.matches.added_errors import in_circle
from bayesdist.app.store.summary import CoverageRow, Holdout, HoldoutTest
from bayesdist.assess.domain import WHOLE, in_region
from bayesdist.assess.evaluation import EvaluationSettings
from bayesdist.assess.model import ErrorModel, with_diagnosed_errors
from bayesdist.diagnose.diagnostics import Diagnostics, diagnose_fit, diagnose_posterior
from bayesdist.diagnose.holdout.predictive import ExposureDeviations, Predictive, predictive_of
from bayesdist.diagnose.holdout.validation import HoldoutValidation, holdout_validation
from bayesdist.infer import Posterior
from bayesdist.infer.catalogue.star_errors import StarInfluence, star_influence


def diagnose_run(posterior: Posterior, data: FitData, config: Config, base: Path) -> Diagnostics:
    """Diagnostics of a posterior and of the held-out stars."""
    fitted = data.fitted
    scatter, tables = fitted.scatter, fitted.tables.tables
    diagnostics = diagnose_posterior(
        diagnose_residuals(posterior, data, config),
        data.fit,
        posterior,
        data.stars,
        data.shards,
        rng=assessment_rng(config),
        tested=data.matched.with_motions(data.sample),
        discrepancy=config.discrepancy.priors(),
        priors=fitted.priors,
        match_radius=config.match_radius(data.matched.stars.match_radius),
        # fitted tables have absorbed the structure; their errors and the distortion between their
        # nodes are terms of the budget
        structure=scatter is None or config.tables.method == "none",
        exposures=scatter is None,
        settling=None if scatter is None else scatter.offsets,
        catalogue=data.matched.star_errors,
        eliminated=None if fitted.solved is None else fitted.solved.mode,
        periods=period_settings(data, config),
    )
    diagnostics = replace(diagnostics, overlap=data.matched.overlap(posterior, tables))
    if data.held is None:
        return diagnostics
    errors = errors_of_run(posterior, diagnostics, data, config)
    settings = evaluation_settings(data, config)
    predictive = predictive_of_run(posterior, diagnostics, errors, data, settings)
    held = holdout_validation(predictive, data.held, whole=data.matched.whole)
    return replace(diagnostics, holdout=held)


def diagnose_residuals(posterior: Posterior | None, data: FitData, config: Config) -> Diagnostics:
    """Diagnostics from residuals, of a posterior or of a fit alone."""
    fitted, kind = data.fitted, kind_of(config)
    # True if centroid errors were estimated by the fit
    measured = fitted.scatter is not None or fitted.solved is not None
    diagnostics = diagnose_fit(
        data.fit,
        posterior,
        data.stars,
        data.shards,
        data.sample,
        eliminated=None if fitted.solved is None else fitted.solved.mode,
        centroid=fitted.errors.by_magnitude if measured else "residuals",
        known=fitted.priors.joint is not None,
        match_radius=config.match_radius(data.matched.stars.match_radius),
        in_circle=in_circle(data.matched.stars, config),
        matched_before=config.data is not None,
        error_scale=data.error_scale_sentence,
        rows=kind.rows,
        chooser=kind.chooser,
    )
    if config.field == WHOLE:
        return diagnostics
    inside = partial(in_region, config.field, data.model.chips[0].size)
    return replace(
        diagnostics, coverage=tuple(coverage.within(inside) for coverage in diagnostics.coverage)
    )


TOGETHER = 1.5  # node spacings over which errors of tables are correlated, from their covariance


def predictive_of_run(
    posterior: Posterior,
    found: Diagnostics,
    errors: ErrorModel,
    data: FitData,
    settings: EvaluationSettings,
) -> Predictive:
    """Predictive distribution of the assessed solution for the held-out stars.

    Quoted errors and jitter include the distortion that the model leaves out at a position.  That
    error is common to neighbouring stars.  Exposures that were fitted jointly scatter, and have
    errors of the catalogue and of tables in addition.
    """
    scatter = data.fitted.scatter
    if scatter is not None:
        cell, tables = None, data.fitted.tables.tables
        if tables:
            across, up = tables[0].step
            cell = TOGETHER * across, TOGETHER * up
        return replace(
            predictive_of(with_diagnosed_errors(posterior, found, data.fit)),
            deviations=ExposureDeviations(scatter.kinds, scatter.tau),
            stars=_known_stars(data),
            local=errors.local_tables(settings.grid, settings.epoch),
            cell=cell,
        )
    out = predictive_of(with_diagnosed_errors(posterior, found))
    rows = None if found.correlated is None else found.correlated.facts.get("structure")
    if not rows:
        return out
    side = max(row["length_pix"] for row in rows)
    local = errors.local_tables(settings.grid, settings.epoch)
    return replace(out, local=local, cell=(side, side), local_in_noise=True)


def _known_stars(data: FitData) -> StarInfluence | None:
    """Influence of the catalogue errors on the fit, for stars of exposures held out entirely.

    These stars were fitted in other exposures, which does not show in their residuals.
    """
    errors, held = data.matched.star_errors, data.matched.held
    if errors is None or held is None or held.star is None:
        return None
    is_held = np.isin(held.exposure_names, data.matched.whole)
    codes = np.unique(held.star[is_held[held.exposure]])
    return star_influence(data.fit, data.stars, errors, codes)


def holdout_table(found: HoldoutValidation) -> Table:
    """Table of all tests, the most significant first."""
    names = "name part is_omnibus where n value expected p_value p_corrected limit".split()
    table = Table({name: [getattr(t, name) for t in found.tests] for name in names})
    table["lo95"], table["hi95"] = np.array([t.interval for t in found.tests]).T
    table["limit"].description = "of tails, in sigma; scatter of deviations"
    table["value"].description = (
        f"offset: {found.unit}; spread: factor on the predicted errors; distribution: largest "
        "difference of distribution functions; tails: fraction of stars; deviation: in its own unit"
    )
    table.meta = {
        "verdict": found.verdict,
        "n": found.n,
        "n_excluded": found.n_left_out,
        "exposures": list(found.exposures),
        "p_corrected": "Holm 1979, over all tests of this table",
    }
    return table


def holdout_summary(found: HoldoutValidation) -> dict[str, Any]:
    """Section 'holdout' of summary.json."""
    return Holdout.row(
        found,
        n_excluded=found.n_left_out,
        coverage=[CoverageRow.row(row, sigma=row.level) for row in found.coverage],
        tests=[HoldoutTest.row(row) for row in found.tests],
    )
