"""Report of a run: its figures and report.html, and what only the report asks of a run."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path

from bayesdist.app.calibrations import difference_from_previous
from bayesdist.app.products.made_files import product_of_run
from bayesdist.app.run import Run
from bayesdist.assess.comparison.compare import Comparison
from bayesdist.files.atomic import atomic_path

log = logging.getLogger("bayesdist")


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
