"""Report of a run with its figures, what only the report asks of a run, and pages for many runs."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from bayesdist.app.calibrations import difference_from_previous
from bayesdist.app.config import config_of_record
from bayesdist.app.products import product_of_run
from bayesdist.app.run import Run
from bayesdist.app.screen import table_text
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.store.summary import head_of
from bayesdist.assess.comparison.compare import Comparison
from bayesdist.files.atomic import atomic_path
from bayesdist.utils.text import with_mas

if TYPE_CHECKING:
    from bayesdist.report.run_report import OverviewRow

log = logging.getLogger("bayesdist")

NO_VERDICT = "no verdict is recorded; 'bayesdist stage report' makes one"


def report(run: Run, *, pdf: bool = False) -> list[str]:
    """Write the report to the folder of the run, and return the names of its figures."""
    # imported here because plotting takes seconds to import
    from bayesdist.report.drawing import save_drawings
    from bayesdist.report.run_report import draw_report, write_report
    from bayesdist.report.sections.status import verdict

    directory = run.directory
    drawings = draw_report(run, pdf=pdf, processes=2 if _is_command_line() else 1)
    names = [path.name for path in save_drawings(drawings, directory / "figures")]
    write_report(directory / "report.html", run, drawings)
    overall = verdict(run)
    directory.summarise(verdict={"level": overall.level, "headline": overall.headline})
    log.info("report: %s", directory / "report.html")
    return names


def write_html_report(run: Run, path: Path) -> None:
    """Write the report of a run to one HTML file.

    Parameters
    ----------
    run : Run
    path : pathlib.Path

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    from bayesdist.report.run_report import draw_report, render_report

    text = render_report(run, draw_report(run))
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _is_command_line() -> bool:
    """True if other processes may import the main module; that of a user may be unguarded."""
    path = Path(getattr(sys.modules["__main__"], "__file__", None) or "")
    name = path.parent.stem if path.name == "__main__.py" else path.stem
    return name == "bayesdist" and (os.cpu_count() or 1) > 1


def comparison_with_previous(run: Run) -> tuple[Comparison, ...]:
    """Difference from the release that the run replaces, by chip; empty if none is named."""
    previous = run.config.products.previous
    if previous is None:
        return ()
    product = product_of_run(run)
    return difference_from_previous(
        product.calibration, run.base / previous, product.options.epoch, previous
    )


def overview(runs: Sequence[str | Path], output: str | Path) -> str:
    """Write a page that compares runs by their summary.json, and return the text to print."""
    from bayesdist.report.run_report import write_overview

    rows = [_row(RunDirectory(run), Path(output)) for run in runs]
    table = [
        {"Status": row.level.replace("fail", "FAIL"), "Run": row.name, "Verdict": row.headline}
        for row in write_overview(output, rows)
    ]
    return f"{table_text(table)}\n\npage: {output}"


def _row(run: RunDirectory, output: Path) -> OverviewRow:
    from bayesdist.report.run_report import OverviewRow

    if not run.is_initialized:
        raise run.not_a_run_error()
    summary, head = run.summary, head_of(run.facts)
    config = config_of_record(run.facts["config"], str(run.path))
    margins: list[Mapping[str, Any]] = summary.get("margins") or []
    worst = min(margins, key=lambda row: row["margin_percent"], default=None)
    until, is_open = _validity(summary.get("validity_periods") or [])
    map_section, fit = summary.get("map"), summary.get("fit")
    verdict = summary.get("verdict") or {"level": "note", "headline": NO_VERDICT}
    damage = next(filter(None, map(run.damage, run.record.artefacts)), None)
    if damage is not None:  # the recorded verdict is for other files
        verdict = {"level": "fail", "headline": " ".join(damage)}
        log.warning("%s: WARNING: %s %s", run.path, *damage)
    report, link = run / "report.html", ""
    if report.exists():  # address relative to the page
        link = quote(os.path.relpath(report.resolve(), output.resolve().parent))
    return OverviewRow(
        name=run.path.as_posix(),
        link=link,
        detector=config.detector_title,
        simulated=bool(head["simulated"]),
        level=verdict["level"],
        headline=verdict["headline"],
        worst_margin=None if worst is None else worst["margin_percent"],
        worst_requirement="" if worst is None else worst["name"],
        valid_until=until,
        open_ended=is_open,
        epoch=None if map_section is None else map_section["epoch"],
        uncertainty=""
        if map_section is None or map_section.get("sigma_max") is None  # run of an earlier version
        else with_mas(map_section["sigma_max"], map_section["unit"], config.detector.scale_mas),
        n_used=summary["data"]["n_used"] if summary.get("data") else None,
        chi2_per_dof=fit["chi2"] / fit["dof"] if fit and fit["dof"] else None,
        began=head["began"],
    )


def _validity(rows: Sequence[Mapping[str, Any]]) -> tuple[float | None, bool]:
    """Date at which the first requirement fails, and True if that is a lower bound."""
    dates = [row["date"] for row in rows if row["date"] is not None]
    if dates:
        return min(dates), False
    return (min(row["until"] for row in rows), True) if rows else (None, False)
