"""Stage 'fit': the least-squares solution."""

from __future__ import annotations

import logging

from bayesdist.app.assessment.checks import frames_doubt
from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.summary import fit_sections, log_fit
from bayesdist.app.matches.added_errors import grouping_sentence
from bayesdist.app.results import Results
from bayesdist.app.stages.rehearsal import rehearse_solution
from bayesdist.diagnose.residuals.epoch_shift import epoch_shift
from bayesdist.diagnose.residuals.majority import majority_sentence

__all__ = ["run_fit"]

log = logging.getLogger("bayesdist")


def run_fit(results: Results) -> Results:
    """Fit, unless the rehearsal has, and write what was found."""
    config, kind = results.config, results.kind
    fitted = results.made.get("fitted")
    if fitted is None:
        fitted = kind.fit(results.matched, config, results.base, results.reader)
        results = results.having(fitted=fitted)
    data = results.data
    fitted.save(results.run.path)
    results.run.summarise(**fit_sections(fitted, data.placed, skew=config.fit.skew))
    log_fit(data.fit, kind.rows)
    if kind.begins_with == "fit":
        _log_matches(data, config)
        return results
    if fitted.solved is not None:
        rehearse_solution(results)
        warnings = fitted.solved.gauge.sentences
    else:
        warnings = fitted.facts["deviations"]["warnings"]
    for text in warnings:
        log.warning("fit: WARNING: %s", text)
    if fitted.scatter is not None:
        scatter = fitted.facts["scatter"]
        sizes = ", ".join(f"{name} {found['value']:.2g}" for name, found in scatter.items())
        log.info("fit: scatter of the exposures %s", sizes)
    return results


def _log_matches(data: FitData, config: Config) -> None:
    """What is odd about matched stars, said before hours of sampling."""
    matches, fit = data.placed, data.fit
    for note in matches.notes:
        log.info("fit: %s", note)
    for reason, count in matches.rejected.items():
        log.info("fit: %d rows were left out in reading: %s", count, reason)
    shift = epoch_shift(data.sample, fit)
    if shift is not None and shift.significant:
        log.warning("fit: WARNING: %s", shift.sentence)
    majority = majority_sentence(fit)
    if data.error_scale_sentence:
        log.warning("fit: WARNING: %s", data.error_scale_sentence)
    if text := frames_doubt(data, majority, config):
        log.warning("fit: WARNING: %s", text)
    if data.fitted.grouped is not None:
        log.info("fit: %s", grouping_sentence(data.fitted.grouped, fit.unit))
    if majority:
        log.warning("fit: WARNING: %s", majority)
