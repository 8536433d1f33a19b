"""The calibration that a file or a run holds, as commands take it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from bayesdist.app.products.made_files import further_errors
from bayesdist.app.results import open_results
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.store.summary import Summary
from bayesdist.calibration.calibration import Calibration, calibration_of
from bayesdist.calibration.plane import ARCSEC, Plane
from bayesdist.calibration.subarray import Subarray, subarray_at_corner, subarrays_of_image
from bayesdist.errors import InputError
from bayesdist.files.documents import read_json_as
from bayesdist.infer import LinearFit, load_fit, load_posterior
from bayesdist.infer.solution.solution import Solution
from bayesdist.products.formats.common.content import read_hdus
from bayesdist.products.registry import read_calibration

_SUMMARY = TypeAdapter(Summary)


def calibration_at(
    path: str | Path,
    *,
    filter: str | None = None,
    scale: float | None = None,
    size: tuple[float, float] | None = None,
) -> Calibration:
    """The calibration of a file or a run.

    `path`: a file of any format, a run directory, posterior.nc or fit.nc. `filter`: of an IDCTAB,
    names of both wheels joined by a comma, or the band of WISE meta-data. `scale`: size of a
    corrected pixel in the unit of the calibration. `size`: columns and rows, for a header that does
    not say.
    """
    path = Path(path)
    if not path.exists():
        raise InputError("there is no such file", where=str(path), do="check the name")
    solution = solution_at(path)
    if solution is None:
        found = read_calibration(path, filter=filter, size=size)
    else:
        detector, scale_of, summary = "", None, _summary_of(path)
        if (run := run_of(path)) is not None:
            detector = run.config.detector.name
            unit, pixel = solution.model.unit, pixel_of_run(path)
            if unit != "pix" and pixel is not None:
                scale_of = pixel / ARCSEC[unit], "detector.scale_mas"
        found = calibration_of(solution, str(path), detector=detector, scale=scale_of)
        budget = [] if summary is None else summary.budget or []
        found = replace(found, further=further_errors([row.model_dump() for row in budget]))
    if scale is None:
        return found
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"the scale is {scale}", where="--scale", do="give a positive number")
    return replace(found, scale=float(scale), scale_from="--scale")


def solution_at(path: Path) -> Solution | None:
    """The fit or posterior at a place; None where it is no such file.

    A run directory, or posterior.nc in it, stands for the posterior with the errors that the run
    was assessed with, or for the fit where there is no posterior yet.
    """
    if path.is_dir():
        if not (path / "run.json").exists() and not (path / "posterior.nc").exists():
            raise InputError("is a folder, and no run", where=str(path), do="give a file in it")
        if not (path / "run.json").exists():
            raise InputError(
                "has no run.json, without which the errors that the run was assessed with are not "
                "known",
                where=str(path),
                do=f"restore it, or give {path / 'posterior.nc'}, the bare posterior",
            )
        if "sample" in RunDirectory(path).record.artefacts or not (path / "fit.nc").exists():
            return _as_assessed(path)
        return _fit_at(path / "fit.nc")
    if path.suffix != ".nc":
        return None
    if path.name == "fit.nc":
        return _fit_at(path)
    return _as_assessed(path.parent) if path.name == "posterior.nc" else load_posterior(path)


def _fit_at(path: Path) -> LinearFit:
    """The fit of a file, which is as it was written where it is that of a run."""
    if (path.parent / "run.json").exists():
        RunDirectory(path.parent).refuse_damaged("fit")
    return load_fit(path)


def _as_assessed(folder: Path) -> Solution:
    """The posterior of a folder, with the errors as assessed where it is that of a run."""
    if not (folder / "run.json").exists():
        return load_posterior(folder)
    run = RunDirectory(folder)
    run.require("calibration", ("fit", "sample", "diagnose"))
    with open_results(run) as results:
        return results.solution


def on_the_sky(path: Path, found: Calibration) -> Calibration:
    """Calibration of a run about the point where its stars touch the sky, where they do."""
    summary = _summary_of(path)
    point = None if summary is None or summary.data is None else summary.data.tangent_point
    if point is None or found.plane.kind != "free":
        return found
    return replace(found, plane=Plane("sky", point=(point[0], point[1])))


def run_of(path: Path) -> RunDirectory | None:
    """The run that a folder is, or that a file is of; None where it is of none."""
    home = path if path.is_dir() else path.parent
    return RunDirectory(home) if (home / "run.json").exists() else None


def _summary_of(path: Path) -> Summary | None:
    """Summary of the run that a file or folder is of; None where there is none."""
    run = run_of(path)
    if run is None or not (run / "summary.json").exists():
        return None
    return read_json_as(_SUMMARY, run / "summary.json", do="resume the run, which writes it again")


def pixel_of_run(path: Path) -> float | None:
    """Arcseconds in a pixel as a run was configured; None where nothing says it."""
    run = run_of(path)
    mas = None if run is None else run.config.detector.scale_mas
    return None if mas is None else 1e-3 * mas


def notes_of(found: Calibration, epoch: float | None) -> tuple[str, ...]:
    """Notes for a reader of results by a calibration."""
    first = found.chip(epoch=epoch)
    errors = {
        "none": ("it holds no errors",),
        "sigma": ("its errors come without correlations",),
        "covariance": (),
    }
    return (*first.notes, *errors[first.errors])


def images_of(
    found: Calibration,
    *,
    image: str | Path | None = None,
    ltv: tuple[float, float] | None = None,
    corner: tuple[float, float] | None = None,
) -> dict[int, Subarray]:
    """Where pixels lie on their chips, as one of three options says; empty for whole chips.

    `corner`: the pixel of the chip that is the subarray's first.
    """
    given = [("--image", image), ("--ltv", ltv), ("--corner", corner)]
    named = [name for name, value in given if value is not None]
    if len(named) > 1:
        raise InputError(
            f"{' and '.join(named)} say the same", where="options", do="keep one of them"
        )
    if image is not None:
        sizes = {chip.number: chip.size for chip in found.model.chips}
        headers = (hdu.header for hdu in read_hdus(image))
        return subarrays_of_image(headers, sizes, str(image))
    if ltv is not None:
        return dict.fromkeys(found.numbers, Subarray((ltv[0], ltv[1])))
    if corner is not None:
        return dict.fromkeys(found.numbers, subarray_at_corner(*corner))
    return {}
