"""A campaign carried through a run, and what is claimed of an exposure that is yet to come."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from bayesdist.app.config import load_config
from bayesdist.app.evaluating import assessment_rng
from bayesdist.app.run import Run
from bayesdist.app.stages import make_stages
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess import LocalErrors
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.terms.correlated import INTERPOLATION as BETWEEN
from bayesdist.infer.solution.transforms import reference_gauge, without_frames
from bayesdist.model import DistortionModel
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.utils.random import restarted
from tests.app.support import after_stages

from .campaign_truth import ARCSEC, BRIGHT, EPOCH0, FAINT, NEW, TERMS, CampaignTruth
from .truth import Piece
from .written import toml_text

STAGES = ("match", "fit", "sample")
GRID, DRAWS = (17, 17), 2000


def chip_blocks(chips: Sequence[Piece]) -> list[dict[str, Any]]:
    """Blocks [[chip]] of a configuration, the first chip that of reference."""
    return [
        {
            "number": chip.number,
            "name": f"CHIP{chip.number}",
            "size": [chip.columns, chip.rows],
            "reference_pixel": [(chip.columns + 1) / 2, (chip.rows + 1) / 2],
            "reference": k == 0,
        }
        for k, chip in enumerate(chips)
    ]


def configuration(truth: CampaignTruth, seed: int) -> dict[str, Any]:
    """What a user writes for this campaign, by block."""
    files = {"catalog": "catalog.ecsv", "exposures": "exposures.ecsv", "lists": "lists"}
    return {
        "campaign": files | {"initial_distortion": "start_idc.fits", "mag": [BRIGHT, FAINT]},
        "tables": {"method": "none"},
        "detector": {"scale_mas": 1000 * ARCSEC},
        "chip": chip_blocks(truth.chips),
        "model": {"order": 3, "tdd": {"epoch0": EPOCH0, "terms": TERMS}},
        "sampler": {"target_ess": 400, "seed": seed + 1},
        "assess": {"grid": list(GRID), "draws": DRAWS, "epoch": truth.epoch},
    } | truth.config


def assessed(truth: CampaignTruth, folder: Path, seed: int) -> Run:
    """Results of a run of this campaign, its assessment made."""
    truth.write(folder)
    (folder / "config.toml").write_text(toml_text(configuration(truth, seed)))
    settings, text = load_config(folder / "config.toml")
    directory = RunDirectory.plan(folder / "run", settings, text, folder)
    run = after_stages(directory, *STAGES)
    # how the linear terms went with time takes longer than all the rest, and no error has it
    with patch("bayesdist.kinds.campaign.kind.write_series_tables"):
        return make_stages(run, ("diagnose", "evaluate"))


def actual_error(run: Run, truth: CampaignTruth) -> np.ndarray:
    """Predicted less true positions (NEW, chips * ny * nx, 2) in exposures that are yet to come.

    Whoever uses the calibration there fits shift and rotation, with stars all over the chips.
    """
    solution, epoch = run.solution, run.epoch
    assert epoch is not None
    mean = np.asarray(solution.mean)
    predicted, mosaic = [], []
    for chip in solution.model.chips:
        x, y = mesh(*grid_pixels(chip.size, run.config.assess.grid))
        predicted.append(
            solution.model.predict(mean, x, y, chip=chip.number, epoch=np.full(x.size, epoch))
        )
        piece = next(one for one in truth.chips if one.number == chip.number)
        mosaic.append(np.stack(piece.mosaic(x, y)))
    x, y = np.concatenate(mosaic, axis=1)
    seen = np.concatenate(predicted)
    return np.stack([_aligned(seen, truth.true_map(x, y, epoch, k)) for k in range(NEW)])


def _aligned(predicted: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Difference (N, 2) that no shift and rotation takes up."""
    a, b = predicted - predicted.mean(axis=0), true - true.mean(axis=0)
    left, _, right = np.linalg.svd(b.T @ a)
    return a - b @ (left @ right)


def coefficient_errors(run: Run, truth: CampaignTruth) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Names, errors (n,) and covariance (n, n) of the coefficients, in the gauge of the first chip.

    True are those of the least-squares polynomials through the true map and through its drift.
    """
    bare = without_frames(run.solution)
    first = truth.chips[0].number
    view = reference_gauge(bare, first)
    true = view.transform(_true_coefficients(bare.model, truth))
    u, v = (bare.model.coefficient_slice(first, axis).start for axis in (0, 1))
    fixed = {bare.model.names[k] for k in (u, v, u + 2)}  # they follow from the others
    names = [name for name in bare.model.names if name not in fixed]
    some = [view.model.names.index(name) for name in names]
    return names, (view.mean - true)[some], view.cov[np.ix_(some, some)]


def _true_coefficients(model: DistortionModel, truth: CampaignTruth) -> np.ndarray:
    """Parameters of a model without frames that are nearest to the true map."""
    theta = np.zeros(model.n_params)
    time = model.time
    assert time is not None
    for chip in truth.chips:
        x, y = mesh(*(np.arange(0.5, n, 4.0) + 0.5 for n in (chip.columns, chip.rows)))
        design = model.basis(chip.number).evaluate(x, y)
        at = [truth.common(*chip.mosaic(x, y), EPOCH0 + years) for years in (0.0, 1.0)]
        for axis in (0, 1):
            value, later = (np.linalg.lstsq(design, one[:, axis])[0] for one in at)
            theta[model.coefficient_slice(chip.number, axis)] = value
            for t, (name, *_) in enumerate(time.terms):
                if name == "uv"[axis]:
                    of = model.drift_terms(chip.number)[t]
                    rate = np.linalg.lstsq(of[:, None], later - value)[0]
                    theta[model.tdd_slice(chip.number).start + t * time.n_values] = rate[0]
    return theta


def table_errors(run: Run, truth: CampaignTruth) -> np.ndarray:
    """Of the look-up tables over the grid of the assessment (chips, N, 3, 2).

    Error, and its sigmas by the nodes alone and with what lies between them.  The best polynomial
    is taken off the error, as polynomials follow the tables.
    """
    out = []
    local = {term.name: term for term in run.error_model.terms if isinstance(term, LocalErrors)}
    for table in run.tables.tables:
        chip = next(one for one in truth.chips if one.number == table.chip)
        fine = mesh(*(np.arange(1.0, n, 3.0) for n in (chip.columns, chip.rows)))
        grid = mesh(*grid_pixels((chip.columns, chip.rows), run.config.assess.grid))
        basis = run.solution.model.basis(chip.number)

        def left(x: np.ndarray, y: np.ndarray, table=table, chip=chip) -> np.ndarray:
            return table.evaluate(x, y) - truth.beside(*chip.mosaic(x, y))

        follows = np.linalg.lstsq(basis.evaluate(*fine), left(*fine))[0]
        error = left(*grid) - basis.evaluate(*grid) @ follows
        domain = EvaluationDomain.of_chips(
            run.posterior.model,
            run.config.assess.grid,
            chips=(chip.number,),
            epoch=run.epoch,
        )
        nodes, between = (local[name].sigma(domain) for name in ("look-up tables", BETWEEN))
        out.append(np.stack([error, nodes, np.hypot(nodes, between)], axis=1))
    return np.array(out)


def stated_sigma(run: Run) -> np.ndarray:
    """Standard deviations (N, 2) of all terms of the budget together, over the same grid."""
    errors, settings = run.error_model, run.evaluation_settings
    rng = restarted(assessment_rng(run.config))
    total = errors.at(settings.domain(errors), n=settings.draws, rng=rng).total
    return np.column_stack([total.u, total.v])
