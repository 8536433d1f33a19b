"""The stages of a self-calibration, where they differ from those of matched stars."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from bayesdist.app.selfcal.fit import fit_selfcal, sample_detections
from bayesdist.app.selfcal.matching import match_dithers
from bayesdist.app.selfcal.session import SelfcalSession
from bayesdist.app.selfcal.stars import write_stars
from bayesdist.app.stages import rehearse_solution
from bayesdist.app.stages.assess import run_assess
from bayesdist.app.stages.fit import save_fitted
from bayesdist.app.stages.sample import save_sampled
from bayesdist.products import read_idctab

__all__ = ["SELFCAL_STAGES", "rehearse_selfcal"]

log = logging.getLogger("bayesdist")


def rehearse_selfcal(session: SelfcalSession) -> None:
    """Read all that the run begins with and lay the exposures onto each other.

    Raises
    ------
    BayesdistError
        For inputs that cannot be read or do not go together.
    """
    model, _ = session.given.start
    session.given.known_for(model)
    path = session.base / (session.block.initial_distortion or "")
    if path.suffix == ".fits":
        read_idctab(path)


def _match(session: SelfcalSession) -> None:
    matched = match_dithers(session.config, session.base, given=session.given)
    matched.save(session.run.path)
    session.run.summarise(selfcal=matched.facts)
    session.renew("matched", matched)


def _fit(session: SelfcalSession) -> None:
    session.renew("fitted", fit_selfcal(session.matched))
    save_fitted(session)
    rehearse_solution(session, session.fit)
    for text in session.gauge.sentences:
        log.warning("fit: WARNING: %s", text)


def _sample(session: SelfcalSession) -> None:
    posterior = sample_detections(
        session.fitted, session.config, folder=session.run.path, progress=session.progress
    )
    save_sampled(session, posterior)


def _assess(session: SelfcalSession) -> None:
    run_assess(session)
    known = session.run.summary.get("selfcal", {})
    session.run.summarise(selfcal=known | {"stars": write_stars(session)})


SELFCAL_STAGES: dict[str, Callable[[Any], None]] = {
    "match": _match,
    "fit": _fit,
    "sample": _sample,
    "assess": _assess,
}
