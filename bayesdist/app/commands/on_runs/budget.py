"""`bayesdist budget`: what the error of a position, or of the distance of two, is made of."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bayesdist.app.results import errors_of, open_results
from bayesdist.app.screen import number, table_text
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess.budget.budget import TOTAL, ErrorBudget, place_budget
from bayesdist.assess.maps.uncertainty import circular_error, per_axis
from bayesdist.assess.terms.forms import PRODUCT
from bayesdist.calibration.chip_map import chosen_chip


def budget_at(
    run: str | Path,
    at: tuple[float, float],
    *,
    to: Sequence[tuple[float, float]] = (),
    chip: int | None = None,
    epoch: float | None = None,
    magnitude: float | None = None,
) -> str:
    """The error budget of a pixel `at` (FITS 1-based) of a run that has been sampled, as text.

    With other pixels `to` of the same image it is that of their differences to it.  `chip` is
    needed where there are several; `epoch` (decimal years) is by default that of the assessment;
    with a `magnitude` of the stars the errors of their centroids are a term.
    """
    with open_results(RunDirectory.open(run)) as results:
        results.run.require("budget", ("fit", "sample"))
        numbers = [one.number for one in results.posterior.model.chips]
        number_of = chosen_chip(numbers, chip, where=str(run), argument="--chip")
        errors = errors_of(results)
        x, y = zip(at, *to, strict=True)
        found = place_budget(
            errors,
            x,
            y,
            chip=number_of,
            epoch=results.epoch if epoch is None else epoch,
            magnitude=magnitude,
            relative=bool(to),
        )
        mas = results.config.detector.scale_mas if found.unit == "pix" else None
        return _text(found, at, mas)


def _text(found: ErrorBudget, at: tuple[float, float], scale_mas: float | None) -> str:
    lines = []
    when = "" if found.epoch is None else f" at {found.epoch:.2f}"
    magnitude = found.domain.magnitude
    of = "" if magnitude is None else f", magnitude {magnitude:g}"
    for k, (x, y) in enumerate(zip(found.x, found.y, strict=True)):
        place = f"({x:g}, {y:g}) of chip {found.domain.chips[0]}{when}{of}"
        if found.domain.relative:
            place = f"({at[0]:g}, {at[1]:g}) to {place}"
        rows: list[dict[str, Any]] = []
        for t in found.every:
            u, v = float(t.u[k]), float(t.v[k])
            size = float(per_axis(u, v))
            known = "" if t.relative_error is None else f" +- {number(t.relative_error * size, 1)}"
            row = {
                "term": t.name,
                "kind": "" if t.kind == TOTAL else t.kind,
                f"u ({found.unit})": number(u),
                f"v ({found.unit})": number(v),
                "per axis": f"{number(size)}{known}",
            }
            if scale_mas is not None:
                row["mas"] = number(size * scale_mas)
            for name, probability in (("CE68", 0.68), ("CE95", 0.95)):
                row[name] = number(float(circular_error(u, v, 0.0, probability)), 3)
            rows.append(row | {"source": t.source})
        lines += [place, table_text(rows), ""]
    lines += [
        "1 sigma; per axis: rms of u and v; CE68, CE95: radii that hold 68 and 95 % of such errors",
        "terms of the model are correlated and enter the total jointly",
    ]
    if any(t.kind == PRODUCT for t in found.every):
        lines.append("rows of kind product come on top for the users of that file: in no total")
    return "\n".join(lines)
