"""Stage 1: the linear fit."""

from __future__ import annotations

import logging

from bayesdist.app.added_errors import grouping_sentence
from bayesdist.app.checks import frames_doubt
from bayesdist.app.kinds.stars import fit_stars
from bayesdist.app.kinds.summary import fit_sections, log_fit
from bayesdist.app.session import Session
from bayesdist.diagnose.residuals.epoch_shift import epoch_shift
from bayesdist.diagnose.residuals.majority import majority_sentence

__all__ = ["run_fit", "save_fitted"]

log = logging.getLogger("bayesdist")


def run_fit(session: Session) -> None:
    """Fit matched stars, unless the rehearsal has, and write what was found."""
    if not session.made("fitted"):
        session.renew("fitted", fit_stars(session.matched, session.config, reader=session.reader))
    save_fitted(session)
    matches, fit = session.raw_matches, session.fit
    for note in matches.notes:
        log.info("fit: %s", note)
    for reason, count in matches.rejected.items():
        log.info("fit: %d rows were left out in reading: %s", count, reason)
    shift = epoch_shift(session.sampled_matches, fit)
    if shift is not None and shift.significant:
        log.warning("fit: WARNING: %s", shift.sentence)
    majority = majority_sentence(fit)
    if session.error_scale_sentence:
        log.warning("fit: WARNING: %s", session.error_scale_sentence)
    if text := frames_doubt(session, majority):
        log.warning("fit: WARNING: %s", text)
    if session.grouped_errors is not None:
        log.info("fit: %s", grouping_sentence(session.grouped_errors, fit.unit))
    if majority:  # said before hours of sampling
        log.warning("fit: WARNING: %s", majority)


def save_fitted(session: Session) -> None:
    """Write the fit of a session and its sections of summary.json."""
    fitted = session.fitted
    fitted.save(session.run.path)
    skew = session.config.fit.skew
    session.run.summarise(**fit_sections(fitted, session.raw_matches, skew=skew))
    log_fit(fitted.linear, session.things)
