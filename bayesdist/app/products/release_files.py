"""Stage 4 of a campaign: the files that a pipeline takes in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bayesdist.app.config.products import ReleaseBlock
from bayesdist.calibration.calibration import calibration_of
from bayesdist.calibration.orientation import lay_on
from bayesdist.infer.solution import Solution
from bayesdist.infer.transforms import reference_gauge, without_frames
from bayesdist.model import LookupTable
from bayesdist.products import Period, read_calibration, write_release
from bayesdist.products.registry import lint

__all__ = ["write_files"]


def write_files(
    block: ReleaseBlock,
    chip: int,
    base: Path,
    folder: Path,
    solutions: Mapping[str, Solution],
    tables: Sequence[LookupTable],
    history: Sequence[str] = (),
) -> list[dict[str, Any]]:
    """Write the files of one filter or several, as the configuration of one run says.

    Parameters
    ----------
    block : ReleaseBlock
        Its section [products.release].
    chip : int
        Number of the chip whose axes and zero point define the gauge.
    base : Path
        Folder that its files are relative to.
    folder : Path
    solutions : mapping of filter to Solution
        The configuration's own first: V2 and V3 lie as the reference says of it.
    tables : sequence of LookupTable
        The detector's, and those of filters.
    history : sequence of str
        Lines for HISTORY of all files.

    Returns
    -------
    list of dict
        One entry for each file: path, kind, findings, and of an IDCTAB period and lost.
    """
    calibrations = {
        filter: calibration_of(
            reference_gauge(without_frames(solution), chip), filter, filter=filter
        )
        for filter, solution in solutions.items()
    }
    first = next(iter(calibrations.values()))
    time = first.model.time
    orientation = lay_on(
        first,
        read_calibration(base / block.reference),
        chip=chip,
        epoch=None if time is None else time.epoch0[0],
        scale_arcsec=block.scale_arcsec,
    )
    written = write_release(
        folder,
        block.name,
        calibrations,
        orientation,
        [Period(**one.model_dump()) for one in block.period],
        tables=tables,
        instrument=block.instrument,
        detector=block.detector,
        scale_arcsec=block.scale_arcsec,
        limit_mas=block.limit_mas,
        history=history,
    )
    out: list[dict[str, Any]] = []
    for period, path in written.idctabs.items():
        lost = [asdict(one) for one in written.lost.get(period, ())]
        out.append(_entry(path, "IDCTAB") | {"period": period, "lost": lost})
    others = [] if written.d2im is None else [("D2IMFILE", written.d2im)]
    others += [("NPOLFILE", path) for path in written.npol.values()]
    return out + [_entry(path, kind) for kind, path in others]


def _entry(path: Path, kind: str) -> dict[str, Any]:
    findings = [f"{f.level}: {f.where}: {f.message}" for f in lint(path)]
    return {"path": path.name, "kind": kind, "findings": findings}
