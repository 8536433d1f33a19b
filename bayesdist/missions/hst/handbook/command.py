"""`bayesdist hst handbook`: figures and numbers of section 4.1 of the ACS handbook."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from astropy.table import Table

from bayesdist.app.commands.on_files.calibrations import calibration_of_scale
from bayesdist.app.run import Run
from bayesdist.app.screen import table_text
from bayesdist.app.store.output import record_folder, write_table
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.calibration.calibration import Calibration
from bayesdist.errors import InputError
from bayesdist.missions.hst.handbook.numbers import acs_detector, detector_numbers, handbook_rows
from bayesdist.missions.hst.handbook.whole_detector import WholeDetector

if TYPE_CHECKING:
    from bayesdist.diagnose.residuals.binned import BinnedResiduals


def handbook(
    path: str | Path,
    output: str | Path,
    *,
    filter: str | None,
    epoch: float | None,
    scale: float | None,
    detector: str | None,
    magnification: float | None,
    command: str,
) -> str:
    """Write the numbers and figures of a calibration to a new folder; returns text to print."""
    # figures take seconds to import
    from bayesdist.missions.hst.handbook.figures import (
        area_figure,
        non_linear_figure,
        residual_figure,
    )
    from bayesdist.report.drawing import save_figures

    if detector is not None:
        detector = acs_detector(detector)
    if magnification is not None and not magnification > 0:
        raise InputError(
            f"the magnification is {magnification}",
            where="--magnification",
            do="give a positive number",
        )
    calibration = calibration_of_scale(path, filter=filter, scale=scale, epoch=epoch)
    pixel, _ = calibration.pixel(epoch)
    if detector is None and calibration.instrument == "ACS":
        detector = calibration.detector
    whole_detector = WholeDetector(calibration.in_frame(epoch), pixel)
    title = _title(calibration, filter, epoch)
    with record_folder(Path(output), "handbook.json", command) as (folder, record):
        figures = {
            "non_linear": non_linear_figure(whole_detector, title, magnification=magnification),
            "pixel_area": area_figure(whole_detector, title),
        }
        binned, missing = _residuals(Path(path))
        if binned:
            figures["residuals"] = residual_figure(whole_detector, binned, calibration.unit, title)
        rows = handbook_rows(
            detector_numbers(whole_detector),
            scale=pixel,
            unit=calibration.unit,
            detector=detector or "",
        )
        save_figures(figures, folder)
        write_table(Table(rows), folder / "numbers.ecsv")
        record |= {"calibration": calibration.name, "detector": detector, "figures": list(figures)}
    shown = [{**row, "published": row["published"] or "-"} for row in rows]
    return f"{output}: {', '.join(figures)}{missing}\n{table_text(shown, 5)}"


def _title(found: Calibration, filter: str | None, epoch: float | None) -> str:
    parts = [Path(found.name).resolve().name, filter or "", f"at {epoch:g}" if epoch else ""]
    instrument = "/".join(p for p in (found.instrument, found.detector) if p)
    return ", ".join(p for p in (instrument, *parts) if p)


def _residuals(path: Path) -> tuple[Mapping[int, BinnedResiduals], str]:
    """Mean residuals in cells by chip number, and a clause that explains their absence."""
    home = path if path.is_dir() else path.parent
    product = path.is_file() and path.suffix != ".nc"  # it may be in another unit
    if product or not (home / "run.json").exists():
        return {}, "; no residuals, since this is not a run"
    try:
        with Run.of(RunDirectory.open(home)) as run:
            chips = run.model.chips
            sums = zip(chips, run.diagnostics.shown, strict=True)
            return {chip.number: chip_sums.residuals() for chip, chip_sums in sums}, ""
    except InputError as error:  # the matches were moved: everything else can be shown
        return {}, f"; no residuals: {error}"
