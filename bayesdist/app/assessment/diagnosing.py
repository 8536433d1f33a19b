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
from bayesdist.diagnose.diagnostics import Diagnostics, diagnose_fit, diagnose_posterior
from bayesdist.diagnose.holdout.validation import HoldoutValidation, holdout_validation
from bayesdist.infer import Posterior


def diagnose_run(posterior: Posterior, data: FitData, config: Config, base: Path) -> Diagnostics:
    """Diagnostics of a posterior and of the held-out stars."""
    fitted, kind = data.fitted, kind_of(config)
    questions = kind.questions(data, config)
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
        structure=questions.structure,
        exposures=questions.exposures,
        settling=questions.settling,
        catalogue=data.matched.star_errors,
        eliminated=questions.eliminated,
        periods=period_settings(data, config),
    )
    diagnostics = replace(
        diagnostics, overlap=data.matched.overlap(posterior, fitted.tables.tables)
    )
    if data.held is None:
        return diagnostics
    errors = errors_of_run(posterior, diagnostics, data, config)
    settings = evaluation_settings(data, config)
    predictive = kind.predictive(posterior, diagnostics, errors, data, settings)
    held = holdout_validation(predictive, data.held, whole=data.matched.whole)
    return replace(diagnostics, holdout=held)


def diagnose_residuals(posterior: Posterior | None, data: FitData, config: Config) -> Diagnostics:
    """Diagnostics from residuals, of a posterior or of a fit alone."""
    fitted, kind = data.fitted, kind_of(config)
    questions = kind.questions(data, config)
    diagnostics = diagnose_fit(
        data.fit,
        posterior,
        data.stars,
        data.shards,
        data.sample,
        eliminated=questions.eliminated,
        centroid=questions.centroid,
        known=fitted.priors.joint is not None,
        match_radius=config.match_radius(data.matched.stars.match_radius),
        in_circle=in_circle(data.matched.stars, config),
        matched_before=config.begins_with == "fit",
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
