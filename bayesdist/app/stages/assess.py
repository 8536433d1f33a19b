"""Stage 'assess': what residuals say of the posterior, and what it is worth."""

from __future__ import annotations

import logging

from bayesdist.app.dates import idle_dates
from bayesdist.app.diagnosing import diagnose_run
from bayesdist.app.diagnostics_files import save_diagnostics
from bayesdist.app.evaluation_files import save_evaluation
from bayesdist.app.exposures.linear_terms import line_sections
from bayesdist.app.exposures.series import write_series_tables
from bayesdist.app.holdout import holdout_summary, holdout_table
from bayesdist.app.judging import evaluate_run
from bayesdist.app.output import write_table
from bayesdist.app.periods import periods_summary, periods_table
from bayesdist.app.results import Results
from bayesdist.app.selfcal.stars import write_stars
from bayesdist.checks import warnings_of

__all__ = ["run_assess", "run_diagnose", "run_evaluate"]

log = logging.getLogger("bayesdist")


def run_assess(results: Results) -> Results:
    """Diagnose and evaluate the posterior, and write what was found."""
    if results.fitted.alone is not None:  # first: what it finds doubtful is among the warnings
        write_series_tables(results.run, results.fitted, results.config)
    results = run_evaluate(run_diagnose(results))
    run, fitted = results.run, results.fitted
    if fitted.scatter is not None:  # with all errors that have been measured
        run.summarise(**line_sections(results.solution, results.config.chips()[0].number))
    if fitted.solved is not None:
        known = run.summary.get("selfcal", {})
        run.summarise(selfcal=known | {"stars": write_stars(results)})
    return results


def run_diagnose(results: Results) -> Results:
    """What residuals say, found anew and written, with its tables."""
    run = results.run
    found = diagnose_run(results.posterior, results.data, results.config, results.base)
    save_diagnostics(run, results.fit, results.posterior, found)
    if found.holdout is not None:
        write_table(holdout_table(found.holdout), run / "holdout.ecsv")
        run.summarise(holdout=holdout_summary(found.holdout))
        log.info("assess: %s", found.holdout.verdict)
        log.info("assess: %s", found.holdout.coverage_words)
    periods = found.periods
    if periods is not None:
        write_table(periods_table(periods), run / "periods.ecsv")
        run.summarise(periods=periods_summary(periods))
        for text in (periods.verdict, periods.pattern_sentence, *periods.cautions):
            log.info("assess: %s", text)
    return results.having(stored=found)


def run_evaluate(results: Results) -> Results:
    """Maps, budget, margins and validity periods, evaluated and written."""
    config, posterior = results.config, results.posterior
    found = evaluate_run(
        results.errors,
        posterior,
        results.diagnostics,
        results.data,
        results.product,
        config,
        results.base,
        series=results.series,
    )
    for text in warnings_of(found.checks):
        log.warning("assess: WARNING: %s", text)
    if idle := idle_dates(config, config.requirements()):
        log.warning("assess: WARNING: %s", idle)
    gauge = results.gauge_words
    save_evaluation(results.run, results.fit, posterior, results.solution, gauge, found)
    for one in found.validity:
        log.info("assess: %s", one.sentence)
    worst = max(found.maps, key=lambda m: m.radius_max)
    log.info("assess: largest formal radius %.4g %s", worst.radius_max, worst.unit)
    return results.having(evaluation=found)
