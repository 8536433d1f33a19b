"""Diagnostics of the solution of a run, including held-out stars."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.artefacts.stars import in_circle
from bayesdist.app.assessment.error_terms import assessment_rng
from bayesdist.app.assessment.periods import period_settings
from bayesdist.app.run import Run
from bayesdist.app.store.summary import CoverageRow, HoldoutSection, HoldoutTest
from bayesdist.assess.domain import WHOLE, in_region
from bayesdist.data import Matches, ReferenceCatalog
from bayesdist.diagnose.diagnostics import Diagnostics, diagnose_fit, diagnose_posterior
from bayesdist.diagnose.holdout.validation import HoldoutValidation, holdout_validation
from bayesdist.infer import Posterior


def diagnostics_of_run(run: Run) -> Diagnostics:
    """Diagnostics of a run: of its posterior and of the held-out stars, or of the fit alone."""
    if not run.is_sampled:
        return _from_residuals(run, None)
    config, kind = run.config, run.kind
    questions = kind.questions(run)
    diagnostics = diagnose_posterior(
        _from_residuals(run, run.posterior),
        run.fit,
        run.posterior,
        run.matches,
        run.shards,
        rng=assessment_rng(config),
        tested=_with_motions(run.sample, run.catalogue),
        discrepancy=config.discrepancy.priors(),
        priors=run.priors,
        match_radius=config.match_radius(run.stars.match_radius),
        structure=questions.structure,
        exposures=questions.exposures,
        settling=questions.settling,
        catalogue=kind.star_errors(run),
        eliminated=questions.eliminated,
        periods=period_settings(run),
    )
    diagnostics = replace(diagnostics, overlap=kind.overlap(run))
    if run.held_out is None:
        return diagnostics
    predictive = kind.predictive(run.having(diagnostics=diagnostics))
    held = holdout_validation(predictive, run.held_out, whole=run.held_exposures)
    return replace(diagnostics, holdout=held)


def _from_residuals(run: Run, posterior: Posterior | None) -> Diagnostics:
    """Diagnostics from residuals, of a posterior or of a fit alone."""
    config, kind = run.config, run.kind
    questions = kind.questions(run)
    diagnostics = diagnose_fit(
        run.fit,
        posterior,
        run.matches,
        run.shards,
        run.sample,
        eliminated=questions.eliminated,
        centroid=questions.centroid,
        known=run.priors.joint is not None,
        match_radius=config.match_radius(run.stars.match_radius),
        in_circle=in_circle(run.stars, config),
        matched_before=config.begins_with == "fit",
        error_scale=run.error_scale_sentence,
        rows=kind.words.rows,
        chooser=kind.words.rejection,
    )
    if config.field == WHOLE:
        return diagnostics
    inside = partial(in_region, config.field, run.model.chips[0].size)
    return replace(
        diagnostics, coverage=tuple(coverage.within(inside) for coverage in diagnostics.coverage)
    )


def _with_motions(stars: Matches, catalogue: ReferenceCatalog | None) -> Matches:
    """Stars with their proper motions and errors of these, if the catalogue has them."""
    if catalogue is None or stars.star is None:
        return stars
    names = ("pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v")
    motions = catalogue.by_code(*names)
    if motions is None:
        return stars
    return stars.with_columns(**dict(zip(names, motions[stars.star].T, strict=True)))


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
    return HoldoutSection.row(
        found,
        n_excluded=found.n_left_out,
        coverage=[CoverageRow.row(row, sigma=row.level) for row in found.coverage],
        tests=[HoldoutTest.row(row) for row in found.tests],
    )
