"""`bayesdist plan-dither`: compare dither patterns for a self-calibration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.screen import table_text
from bayesdist.app.store.keys import attributes
from bayesdist.app.store.output import record_folder, write_table
from bayesdist.kinds.selfcal.patterns.config import PlanConfig, load_plan
from bayesdist.kinds.selfcal.patterns.dithers import (
    KINDS,
    PlannedPattern,
    compare_patterns,
    lacking,
    nearly_free,
)

LEGEND = (
    "reach: largest distance of two pointings, pix; free: directions that detections leave free; "
    "the rest is errors of positions over the detector, per axis, 1 sigma, pix (CE68 is 1.51 and "
    "CE95 2.45 times that where both axes are alike); gauge-free: without the free directions; "
    "shape: without shift, rotation and scale, by which patterns are sorted; absolute: without the "
    "zero point alone; -: nothing bounds it"
)


def plan_patterns(path: str | Path, output: str | Path | None = None, command: str = "") -> str:
    """Compare the dither patterns of a file by their expected covariance.

    Parameters
    ----------
    path : path
        TOML file with ``[[pattern]]`` blocks.
    output : path, optional
        New or empty folder for table, record and figure.
    command : str
        Command line, for the record.

    Returns
    -------
    str
        Text to print.
    """
    config = load_plan(path)
    camera = config.camera()
    planned = compare_patterns(config.patterns(), camera, config.stars_planned(), config.known())
    if output is not None:
        _write(Path(output), planned, config, command)
    return _text(planned, config)


def _row(one: PlannedPattern) -> dict[str, Any]:
    """Row of the table for one pattern."""
    problem = one.solution.problem
    rolls = np.unique(np.round(np.degrees(one.pattern.rolls), 3))
    row: dict[str, Any] = {
        "pattern": one.pattern.name,
        "exposures": len(one.pattern),
        "rolls": len(rolls),
        "reach": one.pattern.reach,
        "stars": problem.n_stars,
        "detections": len(problem),
        "free": one.n_free,
    }
    for kind in KINDS:
        row[f"{kind} rms"], row[f"{kind} max"] = one.rms(kind), one.largest(kind)
    return row


def _text(found: Sequence[PlannedPattern], config: PlanConfig) -> str:
    s = config.stars
    lines = [
        f"Order {config.model.order}, {s.per_detector:g} stars per exposure of {s.sigma:g} pix "
        f"each, {100 * s.false:g} % of them false",
        "",
        table_text([_row(planned) for planned in found], 3),
        "",
        LEGEND,
    ]
    for planned in found:
        lines += ["", f"{planned.pattern.name}:"]
        sentences = (*lacking(planned), *planned.solution.gauge.sentences, nearly_free(planned))
        lines += [f"  {sentence}" for sentence in sentences if sentence]
    best, mas = found[0], config.detector.scale_mas
    rms, largest = best.rms("shape"), best.largest("shape")
    if np.isfinite(rms):
        angle = "" if mas is None else f" ({mas * rms:.2g} and {mas * largest:.2g} mas)"
        verdict = f"shape known per axis to {rms:.2g} pix rms, {largest:.2g} at worst{angle}"
    else:
        verdict = "and yet nothing bounds the shape, for want of rolls and of commanded offsets"
    lines += ["", f"Best: {best.pattern.name}, {verdict}"]
    return "\n".join(lines)


def _write(output: Path, found: Sequence[PlannedPattern], config: PlanConfig, command: str) -> None:
    from bayesdist.kinds.selfcal.patterns.figure import pattern_maps
    from bayesdist.report.drawing import save_figures  # plotting takes seconds to import

    with record_folder(output, "plan.json", command) as (folder, record):
        write_table(_table(found), folder / "patterns.ecsv")
        save_figures({"patterns": pattern_maps(found)}, folder / "figures")
        record |= {"config": config.model_dump(), "unit": "pix"}
        record["patterns"] = [_record(planned) for planned in found]


def _table(found: Sequence[PlannedPattern]) -> Table:
    rows = [
        {key.replace(" ", "_").replace("-", "_"): value for key, value in _row(planned).items()}
        | {f"degree_{k}": value for k, value in planned.by_degree.items()}
        | {"lacks": "; ".join(lacking(planned))}
        for planned in found
    ]
    table = Table(rows)
    for name in table.colnames:
        if name == "reach" or name.startswith("degree_") or name.endswith(("_rms", "_max")):
            table[name].unit = "pix"
    table.meta = {"columns": LEGEND}
    return table


def _record(one: PlannedPattern) -> dict[str, Any]:
    """Record of a pattern for scripts; unbounded values are null."""
    gauge, problem = one.solution.gauge, one.solution.problem
    return {
        "name": one.pattern.name,
        "offsets": one.pattern.offsets,
        "rolls_deg": np.degrees(one.pattern.rolls),
        "reach": one.pattern.reach,
        "n_stars": problem.n_stars,
        "n_detections": len(problem),
        "n_free": one.n_free,
        "held": [one.solution.model.names[k] for k in gauge.held],
        "directions": [
            attributes(d, "name sigma_fixed unit") | {"sigma_detections": d.sigma}
            for d in gauge.directions
        ],
        **{
            kind.replace("-", "_"): {"rms": one.rms(kind), "max": one.largest(kind)}
            for kind in KINDS
        },
        "by_degree": one.by_degree,
        "lacks": list(lacking(one)),
        "sentences": list(gauge.sentences),
        "nearly_free": nearly_free(one),
    }
