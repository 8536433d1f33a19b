"""`bayesdist budget` and `bayesdist requirements`: errors and margins of finished runs.

The error budget is that of a position, or of the separation of two positions.  Requirements are
those of a separate file.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from bayesdist.app.commands.inputs import origin_line, read_positions
from bayesdist.app.config import load_requirements
from bayesdist.app.evaluating import idle_dates, margins_of_run, validity_periods_of_run
from bayesdist.app.result_files import margin_rows, margins_text, reasons_of, save_margins
from bayesdist.app.run import Run
from bayesdist.app.screen import number, table_text
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess import Margin, Requirement
from bayesdist.assess.budget import TOTAL, ErrorBudget, place_budget
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.maps import circular_error, per_axis
from bayesdist.assess.terms.forms import PRODUCT
from bayesdist.calibration.chip_map import chosen_chip
from bayesdist.calibration.sky_table import chip_numbers, pixel_columns
from bayesdist.errors import InputError

SCHEMA = 1  # version of the output of --json
COLUMNS = ("x", "y")
CIRCLES = (("CE68", 0.68), ("CE95", 0.95))

# by verdict, in order of precedence
EXIT_CODES = {"missed": 4, "undecided": 6, "not shown": 5}


def budget_at(
    run: str | Path,
    at: tuple[float, float] | None,
    *,
    at_table: str | Path | None = None,
    columns: tuple[str, str] | None = None,
    to: Sequence[tuple[float, float]] = (),
    chip: int | None = None,
    epoch: float | None = None,
    magnitude: float | None = None,
    as_json: bool = False,
) -> str:
    """Error budget of positions in a run that has been sampled, as text.

    Parameters
    ----------
    run : path
    at : tuple of float or None
        FITS 1-based pixel.
    at_table : path, optional
        Table of positions, in place of `at`.
    columns : tuple of str, optional
        Columns of the pixels in the table; x and y by default.
    to : sequence of tuple of float
        Other pixels of the same image: the budget is then that of their separations from `at`.
    chip : int, optional
        Chip number, needed if there are several chips and no column has it.
    epoch : float, optional
        Date in decimal years; that of the assessment by default.
    magnitude : float, optional
        Magnitude of the stars; their centroid error is then a term.
    as_json : bool
        Return JSON with all terms of all positions.

    Returns
    -------
    str

    Raises
    ------
    InputError
        If not exactly one of `at` and `at_table` is given, or a position or chip is invalid.
    """
    if (at is None) == (at_table is None):
        raise InputError(
            "positions are given twice" if at else "no position is given",
            where="budget",
            do="give either --at X Y or --at-table FILE",
        )
    with Run.of(RunDirectory.open(run)) as opened:
        opened.directory.require("budget", ("fit", "sample"))
        numbers = [chip_of_model.number for chip_of_model in opened.posterior.model.chips]
        errors = opened.drawn_errors
        date = opened.epoch if epoch is None else epoch
        mas = opened.config.detector.scale_mas if errors.unit == "pix" else None
        if at_table is not None:
            name = str(at_table)
            table = read_positions(Path(at_table))
            x, y, origin, reason = pixel_columns(table, columns or COLUMNS, None, name)
            chips = chip_numbers(table, chip, numbers, str(run), name)
            budgets = _budgets(errors, x, y, chips, date, magnitude)
            rows = list(_entries(budgets, np.argsort(chips, kind="stable")))
            if as_json:
                return _json(errors.unit, date, magnitude, rows, pixel_origin=origin)
            return "\n".join([_list(rows, errors.unit, mas), origin_line(origin, reason)])
        number_of = chosen_chip(numbers, chip, where=str(run), argument="--chip")
        first = at or (0.0, 0.0)  # `at` is given if there is no table
        positions = np.array([first, *to], float)
        budget = place_budget(
            errors, *positions.T, chip=number_of, epoch=date, magnitude=magnitude, relative=bool(to)
        )
        if as_json:
            rows = list(_entries([budget], range(len(budget.x))))
            rows = [{"from": list(first)} | row for row in rows] if to else rows
            return _json(errors.unit, date, magnitude, rows)
        return _text(budget, first, mas)


def _budgets(
    errors: DrawnErrors,
    x: np.ndarray,
    y: np.ndarray,
    chips: np.ndarray,
    epoch: float | None,
    magnitude: float | None,
) -> list[ErrorBudget]:
    """Error budgets of the positions, one per chip."""
    return [
        place_budget(
            errors, x[chips == k], y[chips == k], chip=int(k), epoch=epoch, magnitude=magnitude
        )
        for k in np.unique(chips)
    ]


def _entries(budgets: Sequence[ErrorBudget], rows: Sequence[int] | Any) -> Iterator[dict[str, Any]]:
    """Entries of all positions; `rows` are the table rows of the positions of the budgets."""
    entries = [
        {
            "x": float(budget.x[k]),
            "y": float(budget.y[k]),
            "chip": budget.domain.chips[0],
            "terms": [
                {
                    "name": t.name,
                    "kind": t.kind,
                    "u": float(t.u[k]),
                    "v": float(t.v[k]),
                    "per_axis": float(per_axis(t.u[k], t.v[k])),
                    "relative_error": t.relative_error,
                    "source": t.source,
                }
                for t in budget.every
            ],
        }
        for budget in budgets
        for k in range(len(budget.x))
    ]
    for k in np.argsort(rows):
        total = entries[k]["terms"][-1]
        total |= _circles(total["u"], total["v"])
        yield entries[k]


def _circles(u: float, v: float) -> dict[str, float]:
    """Radii of the circles of `CIRCLES` for errors along u and v."""
    return {name: float(circular_error(u, v, 0.0, probability)) for name, probability in CIRCLES}


def _json(
    unit: str,
    epoch: float | None,
    magnitude: float | None,
    entries: Sequence[dict[str, Any]],
    *,
    pixel_origin: float = 1.0,
) -> str:
    """JSON of the entries with 1-based x and y; `pixel_origin` is that of the table."""
    content = {"schema": SCHEMA, "unit": unit, "epoch": epoch, "magnitude": magnitude}
    content["pixel_origin_of_table"] = pixel_origin
    return json.dumps(content | {"positions": entries}, indent=1, allow_nan=False)


def _list(entries: Sequence[dict[str, Any]], unit: str, scale_mas: float | None) -> str:
    """One line per position: its total error and the largest of its terms."""
    rows = []
    for entry in entries:
        *terms, total = (t for t in entry["terms"] if t["kind"] != PRODUCT)
        largest = max(terms, key=lambda t: t["per_axis"])
        row = {key: number(entry[key], 7) for key in ("x", "y", "chip")}
        row |= {f"{axis} ({unit})": number(total[axis]) for axis in "uv"}
        row["per axis"] = number(total["per_axis"])
        if scale_mas is not None:
            row["mas"] = number(total["per_axis"] * scale_mas)
        row |= {name: number(total[name], 3) for name, _ in CIRCLES}
        rows.append(row | {"largest term": largest["name"]})
    return "\n".join(
        [
            table_text(rows),
            "",
            "1 sigma of all terms together; per axis: rms of u and v; CE68, CE95: radii that hold "
            "68 and 95 % of such errors; --json has every term",
        ]
    )


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
            uncertainty = (
                "" if t.relative_error is None else f" +- {number(t.relative_error * size, 1)}"
            )
            row = {
                "term": t.name,
                "kind": "" if t.kind == TOTAL else t.kind,
                f"u ({found.unit})": number(u),
                f"v ({found.unit})": number(v),
                "per axis": f"{number(size)}{uncertainty}",
            }
            if scale_mas is not None:
                row["mas"] = number(size * scale_mas)
            row |= {name: number(radius, 3) for name, radius in _circles(u, v).items()}
            rows.append(row | {"source": t.source})
        lines += [place, table_text(rows), ""]
    lines += [
        "1 sigma; per axis: rms of u and v; CE68, CE95: radii that hold 68 and 95 % of such errors",
        "terms of the model are correlated and enter the total jointly",
    ]
    if any(t.kind == PRODUCT for t in found.every):
        lines.append("rows of kind product come on top for the users of that file: in no total")
    return "\n".join(lines)


def validate(run: str | Path, requirements: str | Path) -> tuple[str, int]:
    """Judge a run that has been sampled, and replace its margins and validity periods.

    Parameters
    ----------
    run : path
    requirements : path
        TOML file of ``[[requirement]]`` blocks.

    Returns
    -------
    str
        Text to print.
    int
        Exit code; see `exit_code`.
    """
    asked = load_requirements(requirements)
    directory = RunDirectory.open(run)
    with Run.of(directory) as opened:
        directory.require("requirements", ("fit", "sample"))
        asked = opened.config.within_field(asked)
        with _named_after(requirements, asked):
            margins = margins_of_run(opened, asked)
            periods = validity_periods_of_run(opened, asked)
        fit, posterior, gauge = opened.fit, opened.posterior, opened.gauge_words
        with directory.locked(), directory.judged_by(asked):
            save_margins(directory, fit, posterior, gauge, margins, periods)
        report = directory / "report.html"
        outdated = report.exists() and not directory.done("report")
    idle = idle_dates(opened.config, asked, str(requirements))
    lines = [*_lines(margins), *(period.sentence for period in periods)]
    lines += [f"WARNING: {idle}"] if idle else []
    if outdated:
        lines.append(f"{report} shows earlier margins; renew it by 'bayesdist stage report {run}'")
    return "\n".join(lines), exit_code(margins)


def exit_code(margins: Sequence[Margin]) -> int:
    """Exit code of the first verdict in `EXIT_CODES` that any margin has; 0 if there is none."""
    verdicts = {m.verdict for m in margins}
    return next((code for word, code in EXIT_CODES.items() if word in verdicts), 0)


@contextmanager
def _named_after(path: str | Path, asked: Sequence[Requirement]) -> Iterator[None]:
    """Prefix errors of requirements with the name of their file."""
    try:
        yield
    except InputError as error:
        if not error.where.startswith(tuple(r.where for r in asked)):
            raise
        raise type(error)(error.cause, where=f"{path}: {error.where}", do=error.do) from error


def _lines(margins: Sequence[Margin]) -> Iterator[str]:
    rows = margin_rows(margins)
    yield margins_text(rows)
    yield from reasons_of(rows)
