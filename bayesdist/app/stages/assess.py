"""Stage 3: what residuals say of the posterior, and what it is worth."""

from __future__ import annotations

import logging

from bayesdist.app.dates import idle_dates
from bayesdist.app.evaluation_files import save_evaluation
from bayesdist.app.holdout import holdout_summary, holdout_table
from bayesdist.app.judging import evaluated
from bayesdist.app.periods import periods_summary, periods_table
from bayesdist.app.session import Session, write_table
from bayesdist.checks import warnings_of
from bayesdist.diagnose.diagnostics import Diagnostics

__all__ = ["diagnose_run", "run_assess"]

log = logging.getLogger("bayesdist")


def run_assess(session: Session) -> None:
    diagnose_run(session)
    requirements = session.config.requirements()
    found = evaluated(session, requirements)
    for text in warnings_of(found.checks):
        log.warning("assess: WARNING: %s", text)
    if idle := idle_dates(session.config, requirements):
        log.warning("assess: WARNING: %s", idle)
    save_evaluation(session, found)
    for one in found.validity:
        log.info("assess: %s", one.sentence)
    worst = max(found.maps, key=lambda m: m.radius_max)
    log.info("assess: largest formal radius %.4g %s", worst.radius_max, worst.unit)


def diagnose_run(session: Session) -> Diagnostics:
    """What residuals say, found anew, with its tables."""
    run, found = session.run, session.diagnose()
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
    return found
