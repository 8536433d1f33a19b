"""The solution of a self-calibration at its mode, and its posterior."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from bayesdist.app.config import Config
from bayesdist.app.kinds.errors import ErrorLaw
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.fitted import Fitted, required
from bayesdist.app.kinds.selfcal.gauge import gauge_summary
from bayesdist.app.kinds.selfcal.matched import SelfcalMatched
from bayesdist.app.kinds.selfcal.matches import magnitude_errors_of
from bayesdist.app.kinds.selfcal.solved import arrays_of, solved_of
from bayesdist.infer import GaussianPriors, Posterior
from bayesdist.infer.selfcal import sample_selfcal
from bayesdist.infer.selfcal.mode import solve_in_gauge

__all__ = ["fit_selfcal", "sample_detections"]


def fit_selfcal(matched: SelfcalMatched) -> Fitted:
    """Mode and gauge of a self-calibration, in one decision.

    Raises
    ------
    DegenerateError, NotSettledError
        As `solve_in_gauge`.
    """
    inputs, model = matched.inputs, matched.problem.model
    mode = solve_in_gauge(
        matched.problem,
        matched.theta,
        inputs.known_for(model),
        stars=matched.places,
        mixture=matched.mixture,
        jitter=inputs.jitter,
    )
    solved = solved_of(matched, model, arrays_of(mode, matched.theta))
    summary = gauge_summary(solved.gauge, solved.fixed, model)
    return Fitted(
        mode.solution,
        ErrorLaw(by_magnitude=magnitude_errors_of(solved.mode, solved.matches)),
        GaussianPriors.none(model),
        solved=solved,
        facts={"selfcal": {**matched.facts, "gauge": summary}},
    )


def sample_detections(
    data: FitData,
    config: Config,
    *,
    folder: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Posterior:
    """The posterior of a self-calibration, with errors in the unit of u, v."""
    return sample_selfcal(
        required(data.fitted.solved, "solution of detections").mode,
        outliers=config.mixture(),
        **config.sampler.model_dump(),
        folder=folder,
        progress=progress,
        compute=config.resources(),
    )
