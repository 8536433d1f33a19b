"""The solution of a self-calibration at its mode, and its posterior."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.config import Config
from bayesdist.app.kinds.errors import ErrorLaw, read_magnitude_errors
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.fitted import FIT, Fitted, required
from bayesdist.app.selfcal.gauge import fixed_by, gauge_summary
from bayesdist.app.selfcal.matched import SelfcalMatched
from bayesdist.app.selfcal.matches import magnitude_errors_of, matches_of
from bayesdist.app.selfcal.solved import SelfCalibrated, arrays_of, read_solution
from bayesdist.infer import GaussianPriors, Posterior, load_fit
from bayesdist.infer.selfcal import SelfCalibrationMode, sample_selfcal
from bayesdist.infer.selfcal.elimination import Mixture, expand
from bayesdist.infer.selfcal.gauge import Decision
from bayesdist.infer.selfcal.mode import gauge_of, solve_in_gauge
from bayesdist.model import DistortionModel

__all__ = ["fit_selfcal", "load_fitted_selfcal", "sample_detections"]

RELINEARISED = 3  # times a problem is linearised anew about a solution that is read


def fit_selfcal(matched: SelfcalMatched) -> Fitted:
    """Mode and gauge of a self-calibration, in one decision.

    Parameters
    ----------
    matched : SelfcalMatched

    Returns
    -------
    Fitted

    Raises
    ------
    DegenerateError, NotSettledError
        As `solve_in_gauge`.
    """
    given, model = matched.given, matched.problem.model
    mode = solve_in_gauge(
        matched.problem,
        matched.theta,
        given.known_for(model),
        stars=matched.places,
        mixture=matched.mixture,
        jitter=given.jitter,
    )
    solved = _solved(matched, model, arrays_of(mode, matched.theta))
    summary = gauge_summary(solved.gauge, solved.fixed, model)
    return Fitted(
        mode.solution,
        ErrorLaw(by_magnitude=magnitude_errors_of(solved.mode, solved.matches)),
        GaussianPriors.none(model),
        solved=solved,
        facts={"selfcal": {**matched.facts, "gauge": summary}},
    )


def load_fitted_selfcal(
    folder: Path, matched: SelfcalMatched, summary: Mapping[str, Any]
) -> Fitted:
    """The fit of an earlier stage.

    Parameters
    ----------
    folder : Path
        Of the run.
    matched : SelfcalMatched
        What it was made from.
    summary : mapping
        Content of summary.json.

    Raises
    ------
    InputError
        For missing or damaged files.
    """
    linear = load_fit(folder / FIT)
    return Fitted(
        linear,
        ErrorLaw(by_magnitude=read_magnitude_errors(folder)),
        GaussianPriors.none(linear.model),
        solved=_solved(matched, linear.model, read_solution(folder)),
        facts={"selfcal": summary.get("selfcal", {})},
    )


def sample_detections(
    data: FitData,
    config: Config,
    *,
    folder: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Posterior:
    """The posterior of a self-calibration.

    Parameters
    ----------
    data : FitData
        Of a self-calibration.
    config : Config
    folder : Path, optional
        For checkpoints.
    progress : callable, optional
        Called with (steps made, most steps).

    Returns
    -------
    Posterior
        With errors in the unit of u, v.
    """
    s = config.sampler
    return sample_selfcal(
        required(data.fitted.solved, "solution of detections").mode,
        outliers=config.mixture(),
        seed=s.seed,
        ensembles=s.ensembles,
        target_ess=s.target_ess,
        target_rhat=s.target_rhat,
        max_steps=s.max_steps,
        checkpoint_every=s.checkpoint_every,
        folder=folder,
        progress=progress,
    )


def _solved(
    matched: SelfcalMatched, model: DistortionModel, arrays: Mapping[str, NDArray[Any]]
) -> SelfCalibrated:
    """A solution from its arrays, so that a stage that reads it has the very numbers."""
    given, held = matched.given, arrays["held"].astype(np.int64)
    theta, stars = arrays["theta"], arrays["stars"]
    jitter, fraction = (float(v) for v in arrays["mixture"])
    n_null, n_open = (int(n) for n in arrays["n_free"])
    mixture, known = Mixture(jitter, fraction), given.known_for(model)
    problem = given.problem(model, matched.detections, theta, matched.theta)
    for _ in range(RELINEARISED):
        problem = problem.at(theta, stars)
    found = expand(problem, theta, mixture, stars)
    solution = SelfCalibrationMode(
        problem,
        theta,
        problem.found_again(theta, found.stars),
        mixture,
        np.setdiff1d(np.arange(model.n_params), held),
        found,
        known(arrays["reference"]),
        Decision(n_null, n_open, held),
    )
    gauge = gauge_of(problem, theta, known(theta), solution)
    places = solution.stars
    return SelfCalibrated(
        solution,
        gauge,
        fixed_by(gauge, solution, known),
        matches_of(problem, places, matched.detections, given.inputs, matched.unused),
        arrays,
        tuple(known.contradictions(theta)),
    )
