"""Solution of a self-calibration: its mode, its posterior, and its restoration by later stages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.artefacts.stars import ErrorLaw
from bayesdist.app.artefacts.stored_fit import FIT_AGAIN, read_stored_fit
from bayesdist.app.run import Run
from bayesdist.files.hdf5 import read_arrays
from bayesdist.infer import Compute, GaussianPriors, Posterior
from bayesdist.kinds.selfcal.gauge import fixed_by, gauge_summary, gauge_table, gauge_words
from bayesdist.kinds.selfcal.infer import SelfCalibrationMode, sample_selfcal
from bayesdist.kinds.selfcal.infer.elimination import Mixture, one_cluster
from bayesdist.kinds.selfcal.infer.gauge import Decision
from bayesdist.kinds.selfcal.infer.mode import gauge_of, mode_at, solve_in_gauge
from bayesdist.kinds.selfcal.inputs import Inputs
from bayesdist.kinds.selfcal.matched import (
    FirstSolution,
    magnitude_errors_of,
    matches_of,
    unused_detections,
)
from bayesdist.kinds.selfcal.solved import SOLUTION, SelfCalibrated
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float

ARRAYS = ("theta", "stars", "mixture", "held", "n_free", "reference")
RELINEARISED = 3  # number of times a problem is relinearised about a restored solution


def arrays_of(solution: SelfCalibrationMode, reference: Float) -> dict[str, NDArray[Any]]:
    """Arrays that store a solution; `reference` (D,) is where the constraints were linearised."""
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


def load_selfcal(run: Run) -> Run:
    """Run with the fit of an earlier stage, including its solution."""
    folder = run.directory.path
    artefacts = read_stored_fit(folder)
    path = folder / SOLUTION
    arrays = read_arrays(path, "", "a solution of detections", ARRAYS, do=FIT_AGAIN)
    solved = solved_of(run, artefacts["fit"].model, arrays, run.config.resources())
    return run.having(**{**artefacts, "parts": {"solved": solved}})


def solved_of(
    run: Run,
    model: DistortionModel,
    arrays: Mapping[str, NDArray[Any]],
    compute: Compute | None,
) -> SelfCalibrated:
    """Restore the solution that `arrays_of` stored.

    The fit itself uses the restored solution, so that later stages obtain the same one.
    """
    inputs: Inputs = run.inputs
    first, held = run.part(FirstSolution), arrays["held"].astype(np.int64)
    theta, stars = arrays["theta"], arrays["stars"]
    jitter, fraction = (float(v) for v in arrays["mixture"])
    n_null, n_open = (int(n) for n in arrays["n_free"])
    mixture, constraints = Mixture(jitter, fraction), inputs.known_for(model)
    problem = inputs.problem(model, first.detections, theta, first.theta)
    for _ in range(RELINEARISED):
        problem = problem.at(theta, stars)
    solution = mode_at(
        problem,
        theta,
        stars,
        mixture,
        np.setdiff1d(np.arange(model.n_params), held),
        constraints(arrays["reference"]),
        Decision(n_null, n_open, held),
        compute=compute,
    )
    gauge = gauge_of(problem, theta, constraints(theta), solution)
    fixed, places = fixed_by(gauge, solution, constraints), solution.stars
    contact = inputs.contact(model, first.theta)
    return SelfCalibrated(
        solution,
        gauge,
        fixed,
        gauge_words(gauge, fixed, model, contact),
        gauge_table(gauge, fixed, model),
        matches_of(problem, places, first.detections, inputs, unused_detections(run.match_facts)),
        arrays,
        tuple(constraints.contradictions(theta)),
        inputs.catalog,
        contact,
    )


def fit_selfcal(run: Run) -> Run:
    """Find mode and gauge of a self-calibration together."""
    inputs: Inputs = run.inputs
    first = run.part(FirstSolution)
    model = first.problem.model
    with one_cluster(inputs.config.resources()) as compute:
        mode = solve_in_gauge(
            first.problem,
            first.theta,
            inputs.known_for(model),
            stars=first.places,
            mixture=first.mixture,
            jitter=inputs.jitter,
            compute=compute,
        )
        solved = solved_of(run, model, arrays_of(mode, first.theta), compute)
    summary = gauge_summary(solved.gauge, solved.fixed, model)
    return run.having(
        fit=mode.solution,
        errors=ErrorLaw(by_magnitude=magnitude_errors_of(solved.mode, solved.matches)),
        priors=GaussianPriors.none(model),
        parts={"solved": solved},
        fit_facts={"selfcal": {**run.match_facts, "gauge": summary}},
    )


def sample_detections(
    run: Run,
    *,
    folder: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Posterior:
    """Sample the posterior of a self-calibration, with errors in the unit of u, v."""
    return sample_selfcal(
        run.part(SelfCalibrated).mode,
        outliers=run.config.mixture(),
        **run.config.sampler.model_dump(),
        folder=folder,
        progress=progress,
        compute=run.config.resources(),
    )
