"""Until when the requirements of a run are met: computed by `assess`, shown by `report`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.session import Session, write_table
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.requirements.requirement import Requirement
from bayesdist.assess.requirements.validity import Horizon, horizon_of
from bayesdist.assess.requirements.verdict import effective_draws
from bayesdist.assess.units import pixel_scale_of

__all__ = ["horizon_rows", "horizons_of", "kept_horizons", "last_epoch", "write_horizons"]

STEPS = 40  # epochs of a curve
COLUMNS = ("epoch", "probability", "low", "high", "value")


def last_epoch(session: Session) -> float:
    """The latest date of the data, decimal years."""
    epoch = session.stars.table.epoch
    assert epoch is not None  # the model depends on time
    return float(np.max(epoch))


def horizons_of(
    session: Session, errors: DrawnErrors, requirements: Sequence[Requirement]
) -> tuple[Horizon, ...]:
    """The curve of each requirement that is judged at one date; none without time dependence.

    Parameters
    ----------
    session : Session
    errors : DrawnErrors
    requirements : sequence of Requirement
    """
    years, model = session.config.assess.horizon, session.posterior.model
    if model.time is None or not years:
        return ()
    last = last_epoch(session)
    epochs = np.linspace(last, last + years, STEPS)
    n_effective = effective_draws(session.solution, errors.n_draws)
    grid = session.config.assess.grid
    scale = pixel_scale_of(session.solution, scale_mas=session.config.detector.scale_mas)
    return tuple(
        horizon_of(errors, r, epochs, grid=grid, n_effective=n_effective, pixel_scale=scale)
        for r in requirements
        if r.epochs is None
    )


def write_horizons(session: Session, horizons: Sequence[Horizon]) -> None:
    """Replace the curves of a run: horizon.ecsv and summary.json."""
    path = session.run / "horizon.ecsv"
    session.run.summarise(horizons=horizon_rows(horizons))
    if not horizons:
        path.unlink(missing_ok=True)
        return
    table = Table(
        {
            "requirement": np.concatenate(
                [np.repeat(h.requirement.name, h.epoch.size) for h in horizons]
            ),
            **{name: np.concatenate([getattr(h, name) for h in horizons]) for name in COLUMNS},
        }
    )
    table["epoch"].unit = "yr"
    table.meta = {
        "date": {h.requirement.name: h.date for h in horizons},
        "units_of_value": {h.requirement.name: h.requirement.unit for h in horizons},
        "band": "95 % Clopper-Pearson, of the number of draws",
        "holds": "while the drift goes on as the model has it",
    }
    write_table(table, path)


def horizon_rows(horizons: Sequence[Horizon]) -> list[dict[str, Any]]:
    """Dates as plain rows, for files and for the screen."""
    return [
        {
            "name": h.requirement.name,
            "probability": h.requirement.probability,
            "date": h.date,
            "interval": list(h.interval),
            "until": float(h.epoch[-1]),
            "sentence": h.sentence,
        }
        for h in horizons
    ]


def kept_horizons(path: Path, requirements: Sequence[Requirement]) -> tuple[Horizon, ...]:
    """The curves that `assess` wrote; none where there are none."""
    if not path.exists():
        return ()
    table = Table.read(path)
    out = []
    for r in requirements:
        rows = table[np.asarray(table["requirement"]) == r.name]
        if len(rows):
            curves = {name: np.asarray(rows[name], float) for name in COLUMNS}
            out.append(Horizon(requirement=replace(r, epochs=None), **curves))
    return tuple(out)
