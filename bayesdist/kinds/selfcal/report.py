"""Content that a self-calibration adds to the report of a run."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesdist.app.run import Run
from bayesdist.files.tables import read_ecsv
from bayesdist.kinds.selfcal.solved import SelfCalibrated
from bayesdist.model.grid import outline_pixels
from bayesdist.report.context import DETECTED, SelfcalResults


def report_fields(run: Run) -> dict[str, Any]:
    """Fields of the content of the report: gauge and stars, and the words of the report."""
    model, theta = run.model, run.posterior.mean
    solved, directory, epoch = run.part(SelfCalibrated), run.directory, run.epoch
    outlines = []
    for e in range(len(model.exposures)):
        for chip in model.chips:
            x, y = outline_pixels(chip.size)
            when = None if model.time is None else np.full(len(x), epoch)
            codes = np.full(len(x), e)
            outlines.append(
                model.predict(theta, x, y, exposure=codes, chip=chip.number, epoch=when)
            )
    names = model.names
    results = SelfcalResults(
        words=solved.gauge_words,
        gauge=read_ecsv(directory / "gauge.ecsv"),
        matching=read_ecsv(directory / "matching.ecsv"),
        stars=read_ecsv(directory / "stars.ecsv"),
        outlines=tuple(outlines),
        summary=directory.summary["selfcal"],
    )
    held = frozenset(names[k] for k in solved.gauge.held)
    return {"selfcal": results, "held": held, "words": DETECTED}
