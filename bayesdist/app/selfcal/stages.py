"""The stages of a self-calibration, where they differ from those of matched stars."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from astropy.table import Table

from bayesdist.app.selfcal.gauge import gauge_summary, gauge_table
from bayesdist.app.selfcal.matches import fit_of, magnitude_errors_of
from bayesdist.app.selfcal.matching import matching_of
from bayesdist.app.selfcal.session import SelfcalSession
from bayesdist.app.selfcal.stars import write_stars
from bayesdist.app.session import ERROR_COLUMNS, write_table
from bayesdist.app.stages import rehearse_solution
from bayesdist.app.stages.assess import run_assess
from bayesdist.app.stages.fit import summarise_fit
from bayesdist.app.stages.sample import keep_posterior
from bayesdist.infer import Posterior, save_fit
from bayesdist.infer.selfcal import sample_selfcal
from bayesdist.infer.selfcal.settled import solved_in_gauge
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
    model, _ = session.start
    session.known_for(model)
    path = session.base / (session.block.initial_distortion or "")
    if path.suffix == ".fits":
        read_idctab(path)


def _match(session: SelfcalSession) -> None:
    found = session.calibrated(lambda text: log.info("match: %s", text))
    matching = matching_of(found, session.inputs, session.block.min_detections)
    matching.refuse_strangers()
    session.keep_detections(found)
    write_table(matching.table, session.run / "matching.ecsv")
    session.run.summarise(selfcal=matching.summary)
    for text in matching.summary["warnings"]:
        log.warning("match: WARNING: %s", text)
    log.info("match: %s", matching.sentence)
    if session.tangent_plane is not None:
        moved = matching.summary["tangent_planes_pix"]
        log.info("match: detections moved by up to %.2g pix onto one tangent plane", moved)


def _fit(session: SelfcalSession) -> None:
    model, theta, stars, mixture = session.matched
    problem = session.problem_at(model, theta)
    solution = solved_in_gauge(
        problem,
        theta,
        session.known_for(model),
        stars=stars,
        mixture=mixture,
        jitter=session.jitter,
    )
    session.keep_solution(solution, theta)
    fit = fit_of(solution)
    save_fit(fit, session.run / "fit.nc")
    session.fit_changed()
    errors = magnitude_errors_of(session.solved, session.raw_matches)
    if errors is not None:
        table = Table({name: getattr(errors, name) for name in ERROR_COLUMNS})
        write_table(table, session.run / "magnitude_errors.ecsv")
        session.errors_changed()
    summarise_fit(session, fit)
    table = gauge_table(session.gauge, session.fixed, model)
    write_table(table, session.run / "gauge.ecsv")
    known = session.run.summary.get("selfcal", {})
    session.run.summarise(
        selfcal=known | {"gauge": gauge_summary(session.gauge, session.fixed, model)}
    )
    rehearse_solution(session, fit)
    for text in session.gauge.sentences:
        log.warning("fit: WARNING: %s", text)


def _sample(session: SelfcalSession) -> None:
    config, s = session.config, session.config.sampler
    posterior = sample_selfcal(
        session.solved,
        jitter=session.jitter,
        fraction_prior=config.outliers.fraction_prior,
        jitter_scale=config.outliers.jitter_scale,
        seed=s.seed,
        ensembles=s.ensembles,
        target_ess=s.target_ess,
        target_rhat=s.target_rhat,
        max_steps=s.max_steps,
        checkpoint_every=s.checkpoint_every,
        folder=session.run.path,
        progress=session.progress,
    )
    keep_posterior(session, _in_unit(posterior, session.model.pixel_size(session.solved.theta)))


def _in_unit(posterior: Posterior, pixel: float) -> Posterior:
    """A posterior whose errors are pixels, with errors in the unit of u, v like all others."""
    m, hyper = posterior.mixture, dict(posterior.hyper)
    if "j" in hyper:
        hyper["j"] = pixel * hyper["j"]
    lengths = {
        key: None if (value := getattr(m, key)) is None else pixel * value
        for key in ("match_radius", "jitter", "jitter_scale")
    }
    return replace(
        posterior,
        mixture=replace(m, **lengths),
        hyper=hyper,
        reference_sigma=pixel * posterior.reference_sigma,
    )


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
