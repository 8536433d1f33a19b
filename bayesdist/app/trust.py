"""What a reader of a run's numbers has to know: doubts, and whether they may be relied on."""

from __future__ import annotations

from bayesdist.app.holdout import held_out_of
from bayesdist.app.periods import periods_of
from bayesdist.app.session import Session
from bayesdist.assess.requirements.verdict import scatter_too_small
from bayesdist.assess.units import pixel_doubt
from bayesdist.errors import InputError

__all__ = ["frames_doubt", "labelled", "posterior_warnings", "trust", "warnings_of"]

MOST_CHI2 = 1.5


def warnings_of(session: Session) -> list[str]:
    """What a reader of the numbers has to know, each as a sentence."""
    fit, out, circle = session.fit, [*session.doubts], session.in_circle
    out += [one.sentence for one in session.coverages if one.significant]
    if doubt := pixel_doubt(fit):
        out.append(doubt)
    if session.epoch_shift is not None and session.epoch_shift.significant:
        out.append(session.epoch_shift.sentence)
    if session.majority:
        out.append(session.majority)
    if text := frames_doubt(session):
        out.append(text)
    if session.misfit.significant:
        found = session.discrepancy
        held = None if found is None else found.structure_rms
        out.append(
            session.misfit.sentence
            if held is None
            else f"{session.misfit.finding}; the budget holds {held:.2g} {session.misfit.unit} rms "
            "of such structure"
        )
    if session.config.data is not None and session.raw_matches.has_nominal and not circle:
        out.append(
            "the matches have nominal positions, and outliers.match_radius is not given: the "
            "likelihood does not know that they were selected"
        )
    if session.config.assess.exposure == "single" and not session.single_exposures:
        out.append(
            "assess.exposure is 'single', and how single exposures deviate is not known here, so "
            "that errors are those in their mean"
        )
    ratio = fit.chi2 / max(fit.dof, 1)
    small = scatter_too_small(fit.chi2, fit.dof)
    if circle:
        if small:
            out.append(
                f"chi-square per degree of freedom of least squares is {ratio:.2g}: the match "
                "circle cuts the residuals, and draws this fit to the nominal solution; the "
                "posterior knows of the circle"
            )
    elif small:
        out.append(
            f"chi-square per degree of freedom is {ratio:.2g}: the match radius has cut the "
            "residuals, or the quoted errors are too large, and with them all uncertainties"
        )
    if ratio > MOST_CHI2:
        out.append(
            f"chi-square per degree of freedom is {ratio:.3g} with the quoted errors: they are too "
            "small, which the jitter takes up, or the model does not fit"
        )
    return [text[0].upper() + text[1:] for text in out]


def frames_doubt(session: Session) -> str:
    """Frames of the exposures that would make residuals far smaller; empty where none would.

    Asked where the residuals are larger than their errors.
    """
    fit = session.fit
    large = session.majority or session.error_scale != 1.0 or fit.chi2 > MOST_CHI2 * fit.dof
    if not large or session.better_frames is None:
        return ""
    return f"the exposures lie differently: {session.better_frames.sentence}"


def trust(session: Session) -> dict[str, bool]:
    """Whether the posterior may be relied on, for the head of a file."""
    return {"converged": session.posterior.convergence.converged}


def labelled(session: Session) -> dict[str, str]:
    """What must be said of draws that are not exact, for the head of a file."""
    label, gauge = session.posterior.approximation, session.gauge_words
    return ({"posterior": label} if label else {}) | ({"gauge": gauge} if gauge else {})


def posterior_warnings(session: Session) -> list[str]:
    """Those of the fit, and before them what must be said of the draws."""
    label, periods, held = (
        session.posterior.approximation,
        periods_of(session),
        held_out_of(session),
    )
    out = [label[0].upper() + label[1:]] if label else []
    if held is not None and held.level != "pass":
        out.append(held.verdict[0].upper() + held.verdict[1:])
    out += [*warnings_of(session), *_contradictions(session)]
    return [*out, periods.verdict.rstrip(".")] if periods and periods.matters else out


def _contradictions(session: Session) -> list[str]:
    """What the user says of the residuals, and they contradict."""
    if not session.config.in_residuals():
        return []
    try:
        _ = session.centroid
    except InputError as error:
        what = f"{error.where}: {error.cause}, so that no budget of single positions can be made"
        return [what[0].upper() + what[1:]]
    return []
