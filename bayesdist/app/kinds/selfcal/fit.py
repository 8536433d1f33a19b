"""The solution of a self-calibration: its mode, its posterior, and as later stages read it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.config import Config
from bayesdist.app.kinds.errors import ErrorLaw
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.fitted import (
    FIT_AGAIN,
    SOLUTION,
    Fitted,
    SelfCalibrated,
    load_fitted,
    required,
)
from bayesdist.app.kinds.selfcal.gauge import fixed_by, gauge_summary, gauge_table, gauge_words
from bayesdist.app.kinds.selfcal.matched import SelfcalMatched, magnitude_errors_of, matches_of
from bayesdist.files.hdf5 import read_arrays
from bayesdist.infer import Compute, GaussianPriors, Posterior
from bayesdist.infer.selfcal import SelfCalibrationMode, sample_selfcal
from bayesdist.infer.selfcal.elimination import Mixture
from bayesdist.infer.selfcal.gauge import Decision
from bayesdist.infer.selfcal.mode import gauge_of, mode_at, solve_in_gauge
from bayesdist.infer.selfcal.pieces import one_cluster
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float

ARRAYS = ("theta", "stars", "mixture", "held", "n_free", "reference")
RELINEARISED = 3  # times a problem is linearised anew about a solution that is read


def arrays_of(solution: SelfCalibrationMode, reference: Float) -> dict[str, NDArray[Any]]:
    """A solution as arrays; `reference` is where what is known beside it was linearised."""
    mixture, decision = solution.mixture, solution.decision
    counts = (0, 0) if decision is None else (decision.n_null, decision.n_open)
    held = np.setdiff1d(np.arange(len(solution.theta)), solution.free)
    return {
        "theta": solution.theta,
        "stars": solution.stars,
        "mixture": np.array([mixture.jitter, mixture.fraction]),
        "held": held if decision is None else decision.held,
        "n_free": np.array(counts),
        "reference": reference,
    }


def load_selfcal(folder: Path, matched: Callable[[], SelfcalMatched]) -> Fitted:
    """The fit of an earlier stage, with its solution."""
    fitted = load_fitted(folder)
    found = matched()
    compute = found.inputs.config.resources()
    arrays = read_arrays(folder / SOLUTION, "", "a solution of detections", ARRAYS, do=FIT_AGAIN)
    return replace(fitted, solved=solved_of(found, fitted.linear.model, arrays, compute))


def solved_of(
    matched: SelfcalMatched,
    model: DistortionModel,
    arrays: Mapping[str, NDArray[Any]],
    compute: Compute | None,
) -> SelfCalibrated:
    """The solution that `arrays_of` made arrays of: what the fit has is what later stages read."""
    inputs, held = matched.inputs, arrays["held"].astype(np.int64)
    theta, stars = arrays["theta"], arrays["stars"]
    jitter, fraction = (float(v) for v in arrays["mixture"])
    n_null, n_open = (int(n) for n in arrays["n_free"])
    mixture, known = Mixture(jitter, fraction), inputs.known_for(model)
    problem = inputs.problem(model, matched.detections, theta, matched.theta)
    for _ in range(RELINEARISED):
        problem = problem.at(theta, stars)
    solution = mode_at(
        problem,
        theta,
        stars,
        mixture,
        np.setdiff1d(np.arange(model.n_params), held),
        known(arrays["reference"]),
        Decision(n_null, n_open, held),
        compute=compute,
    )
    gauge = gauge_of(problem, theta, known(theta), solution)
    fixed, places = fixed_by(gauge, solution, known), solution.stars
    contact = inputs.contact(model, matched.theta)
    return SelfCalibrated(
        solution,
        gauge,
        fixed,
        gauge_words(gauge, fixed, model, contact),
        gauge_table(gauge, fixed, model),
        matches_of(problem, places, matched.detections, inputs, matched.unused),
        arrays,
        tuple(known.contradictions(theta)),
        inputs.catalog,
        contact,
    )


def fit_selfcal(matched: SelfcalMatched) -> Fitted:
    """Mode and gauge of a self-calibration, in one decision."""
    inputs, model = matched.inputs, matched.problem.model
    with one_cluster(inputs.config.resources()) as compute:
        mode = solve_in_gauge(
            matched.problem,
            matched.theta,
            inputs.known_for(model),
            stars=matched.places,
            mixture=matched.mixture,
            jitter=inputs.jitter,
            compute=compute,
        )
        solved = solved_of(matched, model, arrays_of(mode, matched.theta), compute)
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
