"""One truth carried through a run, and what the run claims of its positions."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.config import load_config
from bayesdist.app.evaluating import assessment_rng, margins_of_run
from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess import Margin, Requirement
from bayesdist.assess.domain import field_statistic
from bayesdist.assess.requirements.verdict import verdict_of
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.utils.random import restarted
from tests.app.support import after_stages

from . import campaign_measure
from .campaign_truth import CampaignTruth
from .fields import SIDE
from .selfcal_errors import lists_of, selfcal_error
from .truth import KINDS, Truth
from .written import toml_text

GRID, DRAWS = (17, 17), 2000
STAGES = ("fit", "sample", "diagnose", "evaluate")
JUDGED = 3  # exposures for which requirements are judged, at most
# name, statistic, limit in units of what the actual error has
ASKED = (("below p95", "p95", 0.9), ("above p95", "p95", 1.6), ("below max", "max", 0.9))
DEFAULTS: dict[str, dict[str, Any]] = {
    "data": {"matches": "stars.parquet", "unit": "pix"},
    "detector": {"name": "A", "size": [SIDE, SIDE]},
    "sampler": {"target_ess": 400},
    "assess": {"grid": list(GRID), "draws": DRAWS},
}


def configuration(truth: Truth, seed: int) -> dict[str, Any]:
    """What a user writes for these stars, by block."""
    config = {name: dict(block) for name, block in DEFAULTS.items()}
    config["sampler"]["seed"] = seed + 1
    if truth.epoch is not None:
        config["assess"]["epoch"] = truth.epoch
    if truth.self_calibrated:
        del config["data"]
    if len(truth.chips) > 1:
        del config["detector"]["size"]
        config["chip"] = campaign_measure.chip_blocks(truth.chips)
    for name, block in truth.config.items():
        config[name] = config.get(name, {}) | block if isinstance(block, dict) else block
    return config


def assessed(truth: Truth, folder: Path, seed: int) -> Run:
    """Results of a run of these stars, its assessment made."""
    if truth.self_calibrated:
        lists_of(truth).write(folder / "stars.ecsv")
    else:
        Table(truth.stars).write(folder / "stars.parquet")
    if truth.dates:
        names, epochs = zip(*truth.dates.items(), strict=True)
        Table({"exposure": names, "epoch": epochs}).write(folder / "exposures.ecsv")
    (folder / "config.toml").write_text(toml_text(configuration(truth, seed)))
    settings, text = load_config(folder / "config.toml")
    directory = RunDirectory.plan(folder / "run", settings, text, folder)
    return after_stages(directory, *(("match", *STAGES) if truth.self_calibrated else STAGES))


def actual_error(
    run: Run, truth: Truth, rng: np.random.Generator, *, kindest: bool = False
) -> np.ndarray:
    """Predicted less true positions (chips * ny * nx, 2) over the grid of the assessment.

    Of a model with frames a position is one in an exposure chosen at random among those whose
    frames were fitted, along the axes of the polynomials, as the budget has it.  It is compared
    with the map that all exposures have in common, seen as that exposure points.  With `kindest`
    the best shift and rotation are taken off.
    """
    model, mean = run.solution.model, np.asarray(run.solution.mean)
    epoch, framed = run.epoch, model.frames != "none"
    code = int(rng.integers(1, len(model.exposures))) if framed else 0
    predicted, true = [], []
    for chip in model.chips:
        x, y = mesh(*grid_pixels(chip.size, run.config.assess.grid))
        when: dict[str, Any] = {"epoch": None if epoch is None else np.full(x.size, epoch)}
        if framed:
            when["exposure"] = np.full(x.size, code)
        predicted.append(np.asarray(model.predict(mean, x, y, chip=chip.number, **when)))
        piece = next(one for one in truth.chips if one.number == chip.number)
        true.append(truth.true_map(*piece.mosaic(x, y), epoch))
    seen, at = np.concatenate(predicted), np.concatenate(true)
    if "solved" in run.parts:
        error = selfcal_error(run, truth, seen, code)
    elif framed:
        error = truth.frames[model.exposures[code]].undone(seen) - at
    else:
        error = seen - at
    return without_motion(error, at) if kindest else error


def without_motion(error: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Errors (N, 2) of positions (N, 2), the best shift and rotation taken off.

    A statement on positions can be read as one of relative positions, and this is its kindest
    reading: no frame of the observer makes the error smaller.
    """
    u, v = at.T
    one, zero = np.ones(len(at)), np.zeros(len(at))
    design = np.concatenate([np.column_stack([one, zero, -v]), np.column_stack([zero, one, u])])
    both = error.T.ravel()
    taken = design @ np.linalg.lstsq(design, both, rcond=None)[0]
    return (both - taken).reshape(2, -1).T


def stated_sigma(run: Run, *, kindest: bool = False) -> np.ndarray:
    """Standard deviations (ny * nx, 2) of all terms of the budget together, over the same grid.

    With `kindest` they are those of an observer who fits shift and rotation, as the actual errors
    of `actual_error` then are.
    """
    errors, settings = run.error_model, run.evaluation_settings
    if kindest:
        errors = replace(errors, aligned=True)
    rng = restarted(assessment_rng(run.config))
    total = errors.at(settings.domain(errors), n=settings.draws, rng=rng).total
    return np.column_stack([total.u, total.v])


def carried(truth: Truth | CampaignTruth, folder: Path, seed: int) -> Run:
    """Results of a run of whatever kind, its assessment made."""
    if isinstance(truth, CampaignTruth):
        return campaign_measure.assessed(truth, folder, seed)
    return assessed(truth, folder, seed)


def compared(
    run: Run,
    truth: Truth | CampaignTruth,
    rng: np.random.Generator,
    *,
    kindest: bool = False,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Actual errors (m, N, 2) and stated ones (N, 2) over the grid, and how many stars there are.

    In m exposures, or once.  With `kindest` the best shift and rotation are taken off, as they are
    always in campaigns.
    """
    if isinstance(truth, CampaignTruth):
        error = campaign_measure.actual_error(run, truth)
        return error, campaign_measure.stated_sigma(run), len(run.matches)
    error = actual_error(run, truth, rng, kindest=kindest)[None]
    return error, stated_sigma(run, kindest=kindest), truth.stars["x"].size


def attainable(margin: Margin, factor: float) -> float:
    """How often a limit of so many times the actual statistic is called met, if errors are exact.

    The actual statistic is then one of the margin's draws: some are far below what is met with the
    probability asked for, and no honest verdict on so small a limit is 'met'.
    """
    asked, draws = margin.requirement.probability, np.sort(margin.draws)
    fractions = np.linspace(asked, 1.0, 501)
    n = margin.n_effective
    enough = [f for f in fractions if verdict_of(f, n, asked)[0] == "met"]
    at_or_under = np.searchsorted(draws, factor * draws, side="right") / draws.size
    return float(np.mean(at_or_under >= enough[0])) if enough else 0.0


def judged(run: Run, error: np.ndarray) -> list[dict[str, Any]]:
    """Verdicts on requirements whose limits are a little under and over the actual error's."""
    requirements = tuple(
        Requirement(name, statistic, factor * float(field_statistic(statistic, error)))
        for name, statistic, factor in ASKED
    )
    return [
        {
            "name": m.requirement.name,
            "limit": m.requirement.limit,
            "value": m.value,
            "probability_met": m.probability_met,
            "attainable": attainable(m, factor),
            "verdict": m.verdict,
            "reason": m.reason,
        }
        for m, (_, _, factor) in zip(margins_of_run(run, requirements), ASKED, strict=True)
    ]


def measured(name: str, seed: int, n: int | None = None) -> dict[str, Any]:
    """What became of one truth of a kind: numbers and texts that JSON holds.

    Returns
    -------
    dict
        kind, seed, n; rms_error, rms_stated (pixels, over grid and axes), within_68, within_95
        (fractions of positions and axes whose error is less than 1 and 1.96 stated sigmas), p95,
        max (of the actual radial error), margins (one dict for each of `ASKED`, with
        the fraction of 'met' that is `attainable` at such a limit), warnings, converged, seconds.
    """
    one = KINDS[name]
    truth = one.truth(seed, n)
    began = time.perf_counter()
    with TemporaryDirectory() as folder, closing(carried(truth, Path(folder), seed)) as run:
        rng = np.random.default_rng([7, seed])
        error, stated, n_stars = compared(run, truth, rng, kindest=one.kindest)
        margins = [margin for one in error[:JUDGED] for margin in judged(run, one)]
        warnings = list(run.directory.summary["warnings"])
        converged = bool(run.posterior.convergence.converged)
    pull = np.abs(error) / stated
    return {
        "kind": name,
        "seed": seed,
        "n": n_stars,
        "rms_error": float(np.sqrt(np.mean(error**2))),
        "rms_stated": float(np.sqrt(np.mean(stated**2))),
        "within_68": float(np.mean(pull < 1.0)),
        "within_95": float(np.mean(pull < 1.96)),
        "p95": float(field_statistic("p95", error[0])),
        "max": float(field_statistic("max", error[0])),
        "margins": margins,
        "warnings": warnings,
        "converged": converged,
        "seconds": time.perf_counter() - began,
    }


def results_of(wanted: Iterable[tuple[str, int]]) -> list[dict[str, Any]]:
    """Results of kinds and seeds; those in the file that BAYESDIST_ADVERSARIAL names are taken."""
    path = os.environ.get("BAYESDIST_ADVERSARIAL")
    found = json.loads(Path(path).read_text()) if path else {}
    return [found.get(f"{name}/{seed}") or measured(name, seed) for name, seed in wanted]
