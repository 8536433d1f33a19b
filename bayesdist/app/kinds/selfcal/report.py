"""Content of the report of a self-calibration, from its results."""

from __future__ import annotations

import numpy as np

from bayesdist.app.kinds.fitted import Fitted, required
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.infer import Posterior
from bayesdist.model.grid import outline_pixels
from bayesdist.reading.tables import read_ecsv
from bayesdist.report.context import SelfcalResults

__all__ = ["selfcal_results"]


def selfcal_results(
    run: RunDirectory, fitted: Fitted, posterior: Posterior, epoch: float | None
) -> SelfcalResults:
    """Content that a self-calibration adds to the report of its run.

    Parameters
    ----------
    run : RunDirectory
        That has been assessed.
    fitted : Fitted
    posterior : Posterior
        As it was sampled.
    epoch : float or None
        Of the assessment, decimal years.
    """
    model, theta = fitted.linear.model, posterior.mean
    solved = required(fitted.solved, "solution of detections")
    outlines = []
    for e in range(len(model.exposures)):
        for chip in model.chips:
            x, y = outline_pixels(chip.size)
            when = None if model.time is None else np.full(len(x), epoch)
            place = {"exposure": np.full(len(x), e), "chip": chip.number, "epoch": when}
            outlines.append(model.predict(theta, x, y, **place))
    names = model.names
    return SelfcalResults(
        words=solved.gauge_words,
        gauge=read_ecsv(run / "gauge.ecsv"),
        matching=read_ecsv(run / "matching.ecsv"),
        stars=read_ecsv(run / "stars.ecsv"),
        outlines=tuple(outlines),
        held=tuple(names[k] for k in solved.gauge.held),
        summary=run.summary["selfcal"],
    )
