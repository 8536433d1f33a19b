"""The stages of a run: fit, sample, assess, export, report; each can be run by itself."""

from __future__ import annotations

from collections.abc import Callable

from bayesdist.app.judging import budget_of, margins_of
from bayesdist.app.made_files import made_files
from bayesdist.app.periods import check_pairs
from bayesdist.app.session import Session
from bayesdist.app.stages.assess import run_assess
from bayesdist.app.stages.export import run_export
from bayesdist.app.stages.fit import run_fit
from bayesdist.app.stages.report import run_report
from bayesdist.app.stages.sample import run_sample
from bayesdist.assess import SAMPLE, star_sample
from bayesdist.assess.terms.centroid import centroid_scatter
from bayesdist.data import MagnitudeErrors
from bayesdist.infer import LinearFit

__all__ = ["rehearse", "rehearse_solution", "run_stage"]

REHEARSAL_DRAWS = 100

_FUNCTIONS: dict[str, Callable[[Session], None]] = {
    "fit": run_fit,
    "sample": run_sample,
    "assess": run_assess,
    "export": run_export,
    "report": run_report,
}


def run_stage(
    session: Session,
    name: str,
    function: Callable[[Session], None] | None = None,
    *,
    force: bool = True,
) -> bool:
    """Run one stage, in the usual way or by another function.

    Parameters
    ----------
    session : Session
    name : str
    function : callable, optional
    force : bool
        Also where it stands.

    Returns
    -------
    bool
        Whether it was run.
    """
    run = function or _FUNCTIONS[name]
    return session.run.make(name, lambda: run(session), force=force)


def rehearse(session: Session) -> None:
    """All that comes after sampling, on the linear fit and with few draws; nothing is written.

    What is wrong with the data or the configuration shows here, before hours of sampling.

    Raises
    ------
    BayesdistError
    """
    check_pairs(session)
    fit, errors = session.linear
    _check_residuals(session, fit, errors)
    rehearse_solution(session, fit)


def rehearse_solution(session: Session, fit: LinearFit) -> None:
    """Budget, margins and files of a fit, with few draws; nothing is written.

    Raises
    ------
    BayesdistError
    """
    config = session.config
    budget_of(session, fit, REHEARSAL_DRAWS)
    margins_of(session, config.requirements(), fit, REHEARSAL_DRAWS)
    made_files(session, fit)


def _check_residuals(session: Session, fit: LinearFit, errors: MagnitudeErrors | None) -> None:
    """Refuse a budget with errors that are said to be in the residuals and are larger than these.

    Raises
    ------
    InputError
    """
    held = session.config.held_in_residuals(fit.model.unit)
    if held:
        raw = session.raw_matches
        matches = session.with_added_errors(
            raw if errors is None else raw.with_errors_by_magnitude(errors)
        )
        stars = star_sample(matches.sample(SAMPLE), len(matches), fit)
        centroid_scatter(stars, held, n_params=fit.model.n_params)
