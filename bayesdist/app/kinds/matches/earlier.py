"""The earlier calibration that is the prior of matched stars."""

from __future__ import annotations

from pathlib import Path

from bayesdist.app.config import Config
from bayesdist.app.config.other_runs import POSTERIOR, calibration_file
from bayesdist.app.kinds.fitted import FIT
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.tables.diagnostics_files import load_diagnostics
from bayesdist.assess.adjusted import with_diagnosed_errors
from bayesdist.calibration.calibration import Calibration, calibration_of
from bayesdist.calibration.prior import CalibrationPrior, prior_of_calibration
from bayesdist.errors import InputError
from bayesdist.infer import Posterior, load_fit, load_posterior
from bayesdist.model import DistortionModel
from bayesdist.products.registry import read_calibration

__all__ = ["earlier_calibration"]


def earlier_calibration(
    model: DistortionModel, config: Config, base: Path
) -> CalibrationPrior | None:
    """Prior of a model by the calibration that a configuration names; None where it names none.

    Raises
    ------
    InputError
        For a file that is no calibration, a run that has not converged, and as
        `prior_of_calibration`.
    """
    block = config.prior_calibration
    if block is None:
        return None
    path = calibration_file(base / block.source)
    return prior_of_calibration(
        _calibration(path, block.filter),
        model,
        frame=block.frame,
        epoch=block.epoch,
        change_pix=block.change_pix,
    )


def _calibration(path: Path, filter: str | None) -> Calibration:
    """Calibration of a file, or of a run with the errors that were found in it."""
    if path.suffix != ".nc":
        return read_calibration(path, filter=filter)
    if path.name == FIT:
        return calibration_of(load_fit(path), str(path))
    posterior: Posterior = load_posterior(path)
    if not posterior.convergence.converged:
        raise InputError(
            f"the run has not converged ({'; '.join(posterior.convergence.reasons)})",
            where=str(path.parent),
            do="resume it with more steps before it is a prior",
        )
    folder = path.parent
    if path.name == POSTERIOR and (folder / "run.json").exists():
        run = RunDirectory(folder)
        # errors that are lost, or were never found, would narrow the prior
        run.require("prior_calibration", ("fit", "sample", "diagnose"))
        fit = load_fit(folder / FIT)
        found = load_diagnostics(run, fit, posterior)
        hierarchy = fit if run.config.campaign is not None else None
        posterior = with_diagnosed_errors(posterior, found, hierarchy)
    return calibration_of(posterior, str(folder))
