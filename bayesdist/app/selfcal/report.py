"""What the report shows of a self-calibration, put together from its session."""

from __future__ import annotations

import numpy as np
from astropy.table import Table

from bayesdist.app.selfcal.session import SelfcalSession
from bayesdist.model.grid import outline_pixels
from bayesdist.report.context import SelfcalResults

__all__ = ["selfcal_results"]


def selfcal_results(session: SelfcalSession) -> SelfcalResults:
    """What a self-calibration adds to the report of its run.

    Parameters
    ----------
    session : SelfcalSession
        Of a run that has been assessed.
    """
    run, model, theta = session.run, session.model, session.posterior.mean
    outlines = []
    for e in range(len(model.exposures)):
        for chip in model.chips:
            x, y = outline_pixels(chip.size)
            when = None if model.time is None else np.full(len(x), session.epoch)
            place = {"exposure": np.full(len(x), e), "chip": chip.number, "epoch": when}
            outlines.append(model.predict(theta, x, y, **place))
    names = model.names
    return SelfcalResults(
        words=session.gauge_words,
        gauge=Table.read(run / "gauge.ecsv"),
        matching=Table.read(run / "matching.ecsv"),
        stars=Table.read(run / "stars.ecsv"),
        outlines=tuple(outlines),
        held=tuple(names[k] for k in session.gauge.held),
        summary=run.summary["selfcal"],
    )
