"""Checks of a run beside what residuals say: of its kind, the sampling, the fit, the catalogue."""

from __future__ import annotations

from collections.abc import Iterator

from bayesdist.app.session import Session
from bayesdist.assess.checks import catalogue_checks, matching_checks, time_checks
from bayesdist.assess.units import pixel_doubt
from bayesdist.checks import LARGER, Check
from bayesdist.diagnose.checks import score_checks
from bayesdist.infer.checks import fit_checks, sampling_checks
from bayesdist.limits import CHI2_TOO_LARGE

__all__ = ["frames_doubt", "provenance_notes", "run_checks"]


def run_checks(session: Session) -> tuple[Check, ...]:
    """Checks of a run that has been sampled, or of a fit alone, beside those of its diagnostics."""
    fit, found = session.fit, session.diagnostics
    posterior = session.posterior if session.is_sampled else None
    return (
        *session.kind_checks(tuple(score_checks(found.score_tests, found.correlated))),
        *sampling_checks(posterior),
        *fit_checks(
            fit, in_circle=session.in_circle, things=session.things, chooser=session.chooser
        ),
        *_remarks(session, found.majority),
        *matching_checks(
            session.config.outliers.match_radius,
            session.shards.survey.reference_sigma,
            in_circle=session.in_circle,
        ),
        *catalogue_checks(session.catalogue_stated),
        *time_checks(fit.model.time, session.dates, session.motions_stated),
    )


def _remarks(session: Session, majority: str) -> Iterator[Check]:
    if doubt := pixel_doubt(session.fit):
        yield Check("Fit", level="warn", sentence=doubt)
    if text := frames_doubt(session, majority):
        yield Check("Fit", level="warn", sentence=text)
    if session.error_scale_sentence:
        yield Check("Fit", sentence=session.error_scale_sentence, doubt=LARGER)
    if session.config.data is None or session.in_circle or not session.raw_matches.has_nominal:
        return
    yield Check(
        "Matching",
        level="warn",
        sentence="the matches have nominal positions, and outliers.match_radius is not given: the "
        "likelihood does not know that they were selected",
    )


def frames_doubt(session: Session, majority: str) -> str:
    """Frames of the exposures that would make residuals far smaller; empty where none would.

    Asked where the residuals are larger than their errors, or most pairs are false.
    """
    fit = session.fit
    too_large = fit.chi2 > CHI2_TOO_LARGE.value * fit.dof
    large = majority or session.error_scale != 1.0 or too_large
    if not large or session.better_frames is None:
        return ""
    return f"the exposures lie differently: {session.better_frames.sentence}"


def provenance_notes(session: Session) -> dict[str, bool | str]:
    """What must be said of the draws, and of the gauge, in the head of a file."""
    label, gauge = session.posterior.approximation, session.gauge_words
    return {
        "converged": session.posterior.convergence.converged,
        **({"posterior": label} if label else {}),
        **({"gauge": gauge} if gauge else {}),
    }
