"""The stages of a run: fit, sample, assess, export, report; each can be run by itself."""

from __future__ import annotations

from collections.abc import Callable

from bayesdist.app.judging import rehearse_evaluation
from bayesdist.app.kinds.stars import fit_stars
from bayesdist.app.made_files import made_files
from bayesdist.app.periods import check_pairs
from bayesdist.app.session import Session
from bayesdist.app.stages.assess import run_assess
from bayesdist.app.stages.export import run_export
from bayesdist.app.stages.fit import run_fit
from bayesdist.app.stages.report import run_report
from bayesdist.app.stages.sample import run_sample
from bayesdist.assess import star_sample
from bayesdist.assess.terms.centroid import centroid_errors
from bayesdist.diagnose.residuals.centroid import centroid_scatter
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
    session.renew("fitted", fit_stars(session.matched, session.config, reader=session.reader))
    _check_residuals(session)
    rehearse_solution(session, session.fit)


def rehearse_solution(session: Session, fit: LinearFit) -> None:
    """Budget, margins and files of a fit, with few draws; nothing is written.

    Raises
    ------
    BayesdistError
    """
    rehearse_evaluation(session, fit, REHEARSAL_DRAWS)
    made_files(session, fit)


def _check_residuals(session: Session) -> None:
    """Refuse a budget with errors that are said to be in the residuals and are larger than these.

    Raises
    ------
    InputError
    """
    fit = session.fit
    held = session.config.held_in_residuals(fit.model.unit)
    if held:
        stars = star_sample(session.tested_matches, len(session.matches), fit)
        scatter = centroid_scatter(stars, n_params=fit.model.n_params)
        if scatter is not None:
            centroid_errors(scatter, held)
