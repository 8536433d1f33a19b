"""Calibration of a file or a run, for `bayesdist.read_calibration` and for commands."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from bayesdist.app.parts import FIT_AGAIN, TABLES, read_tables
from bayesdist.app.products import with_facts_of_run
from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.store.summary import Summary
from bayesdist.assess.comparison.compare import NOISE_SEED, Comparison, compare
from bayesdist.calibration.calibration import Calibration, calibration_of
from bayesdist.calibration.plane import ARCSEC, Plane
from bayesdist.data.tangent import sky_of_plane
from bayesdist.errors import InputError, required
from bayesdist.files.documents import read_json_as
from bayesdist.infer import LinearFit, load_fit, load_posterior
from bayesdist.infer.solution.solution import Solution
from bayesdist.products import registry
from bayesdist.products.common.document import Choice, MissingSizeError
from bayesdist.utils.arrays import Float

__all__ = ["read_calibration"]

_SUMMARY = TypeAdapter(Summary)


def read_calibration(
    file: str | os.PathLike[str],
    *,
    filter: str | None = None,
    size: tuple[float, float] | None = None,
) -> Calibration:
    """Calibration of a file of any format, or of a run.

    Parameters
    ----------
    file : path
        A calibration file (its format is recognized by its content), the folder of a run, or the
        ``posterior.nc`` or ``fit.nc`` in it.
    filter : str, optional
        Filter or band, if the file has several; names in two wheels are joined by a comma.
    size : tuple of float, optional
        Number of columns and rows.  Needed for a header that does not state them.

    Returns
    -------
    Calibration
        With the errors that the file states.  A calibration of a run has all errors of the
        parameters that the run found, and is on the sky if the positions of its stars are.

    Raises
    ------
    InputError
        For a file that cannot be read, is of no known format or holds no calibration, and for a
        filter or size that is missing.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> chip = bd.Chip(1, "camera", (1000, 1000), (500.5, 500.5))
    >>> model = bd.DistortionModel(1, (chip,), "arcsec")
    >>> stars, _ = bd.simulate_matches(model, [0, 100, 0, 0, 0, 100], 500, sigma=0.01, rng=rng)
    >>> fit = bd.fit_linear(stars, model)
    >>> written = bd.Calibration.from_solution(fit).write("parameters", "camera.fits")
    >>> bd.read_calibration("camera.fits")
    <Calibration 'camera.fits': chip 1, order 1, u and v in arcsec, covariance>
    """
    return on_the_sky(Path(file), calibration_at(file, filter=filter, size=size))


def calibration_at(
    path: str | os.PathLike[str],
    *,
    filter: str | None = None,
    size: tuple[float, float] | None = None,
) -> Calibration:
    """Calibration of a file or a run; arguments as for `read_calibration`.

    The plane of u and v of a run is free even if the positions of its stars were on the sky.
    """
    path = Path(path)
    if not path.exists():
        raise InputError("there is no such file", where=str(path), do="check the name")
    solution = solution_at(path)
    if solution is not None:
        _refuse_unused((), "a run", path, filter, size)
        return _calibration_of_run(solution, path)
    document = registry.open_document(path)
    if document.format.calibration is not None:
        _refuse_unused(document.format.asks, document.format.title, path, filter, size)
    calibration = document.calibration(Choice(filter, size))
    sizes = [tuple(map(float, chip.size)) for chip in calibration.model.chips]
    if size is not None and tuple(map(float, size)) not in sizes:
        stated = " and ".join(dict.fromkeys(f"{nx:g} x {ny:g}" for nx, ny in sizes))
        raise InputError(
            f"states a size of {stated} pixels, but {size[0]:g} x {size[1]:g} are given",
            where=str(path),
            do="leave out the size (--size on the command line)",
        )
    return calibration


def common_chips(a: Calibration, b: Calibration) -> list[tuple[int, int]]:
    """Pairs of chip numbers that two calibrations have in common, or their only chips."""
    if a.numbered == b.numbered:
        common = sorted(set(a.numbers) & set(b.numbers))
        if common:
            return [(number, number) for number in common]
    if len(a.numbers) == len(b.numbers) == 1:
        return [(a.numbers[0], b.numbers[0])]
    listed = " and ".join(
        ", ".join(map(str, calibration.numbers)) if calibration.numbered else "none"
        for calibration in (a, b)
    )
    raise InputError(
        f"their chips are {listed}",
        where=f"{a.name}, {b.name}",
        do="choose the chip by --chip, which a file without chip numbers takes for its own",
    )


def difference_from_previous(
    calibration: Calibration, previous: Path, epoch: float | None, name: str | None = None
) -> tuple[Comparison, ...]:
    """Difference between each chip of a calibration and that of the release at `previous`.

    Shift, rotation and scale are fitted and removed. `epoch`, in decimal years, is used for
    calibrations that depend on time.  The filter and the size of the calibration are used if the
    file requires them.  `name` is that of the release in the result (default: its path).
    """
    filter = calibration.filter or None if "filter" in asks_of(previous) else None
    try:
        released = calibration_at(previous, filter=filter)
    except MissingSizeError:
        size = calibration.model.chips[0].size
        released = calibration_at(previous, filter=filter, size=size)
    maps = [
        version.by_chip(epoch if version.model.time is not None else None)
        for version in (calibration, replace(released, name=name or str(previous)))
    ]
    rng = np.random.default_rng(NOISE_SEED)
    return tuple(
        compare(maps[0][n], maps[1][m], rng=rng) for n, m in common_chips(calibration, released)
    )


def asks_of(path: Path) -> tuple[str, ...]:
    """Names of the arguments of `calibration_at` that a file uses: "filter", "size".

    Runs use none.
    """
    if path.is_dir() or path.suffix == ".nc" or not path.exists():
        return ()
    return registry.open_document(path).format.asks


def _refuse_unused(
    asks: tuple[str, ...],
    title: str,
    path: Path,
    filter: str | None,
    size: tuple[float, float] | None,
) -> None:
    """Refuse a filter or a size that a file of this kind does not use."""
    reasons = {"filter": "whose filter is not chosen", "size": "which states its own size"}
    for name, value in (("filter", filter), ("size", size)):
        if value is not None and name not in asks:
            raise InputError(
                f"is {title}, {reasons[name]}",
                where=str(path),
                do=f"leave the {name} (--{name} on the command line) out",
            )


def refuse_unused_date(epoch: float | None, *calibrations: Calibration) -> None:
    """Refuse a date if none of the calibrations depends on time.

    Files that drift but have no reference date refuse a date themselves.
    """
    if epoch is None or any(
        calibration.model.time is not None or calibration.no_date for calibration in calibrations
    ):
        return
    raise InputError(
        "does not depend on time",
        where=" and ".join(dict.fromkeys(calibration.name for calibration in calibrations)),
        do="leave out the date (--epoch on the command line)",
    )


def _calibration_of_run(solution: Solution, path: Path) -> Calibration:
    """Calibration of a solution with facts of its run; `path` is a folder or a file in it."""
    run, summary = run_of(path), _summary_of(path)
    if run is None:
        return calibration_of(solution, str(path))
    tables = read_tables(run / TABLES, do=FIT_AGAIN).tables
    calibration = calibration_of(
        solution,
        str(path),
        detector=run.config.detector.name,
        filter=next((table.filter for table in tables if table.filter), ""),
    )
    budget = [] if summary is None else summary.budget or []
    rows = [row.model_dump() for row in budget]
    discrepancy = None
    if summary is not None and summary.discrepancy is not None:
        discrepancy = summary.discrepancy.model_dump()
    return with_facts_of_run(calibration, run.config, tables, rows, discrepancy)


def solution_at(path: Path) -> Solution | None:
    """Fit or posterior at a path; None if the file is neither.

    For a run directory or its posterior.nc the result is the posterior with the errors that the run
    was assessed with, or the fit if there is no posterior yet.
    """
    if path.is_dir():
        if not (path / "run.json").exists() and not (path / "posterior.nc").exists():
            raise InputError("is a folder, but not a run", where=str(path), do="give a file in it")
        if not (path / "run.json").exists():
            raise InputError(
                "has no run.json, so the errors with which the run was assessed are unknown",
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
    """Fit of a file; if it belongs to a run it must be unchanged."""
    if (path.parent / "run.json").exists():
        RunDirectory(path.parent).refuse_damaged("fit")
    return load_fit(path)


def _as_assessed(folder: Path) -> Solution:
    """Posterior of a folder; if it is a run, with the errors as assessed."""
    if not (folder / "run.json").exists():
        return load_posterior(folder)
    run = RunDirectory(folder)
    run.require("calibration", ("fit", "sample", "diagnose"))
    with Run.of(run) as opened:
        return opened.solution


def on_the_sky(path: Path, found: Calibration) -> Calibration:
    """Calibration of a run in the tangent plane of its stars, if they have one."""
    summary = _summary_of(path)
    point = None if summary is None or summary.data is None else summary.data.tangent_point
    if point is None or found.plane.kind != "free":
        return found
    return replace(found, plane=Plane("sky", point=(point[0], point[1])))


def positions_on_the_sky(found: Calibration, at: Float) -> tuple[Float, Float]:
    """RA and Dec (N,) in degrees of positions (N, 2) in u and v; the plane is on the sky."""
    point = required(found.plane.point, "does not lie on the sky")
    xi, eta = (at * ARCSEC[found.unit]).T
    return sky_of_plane(xi, eta, point)


def run_of(path: Path) -> RunDirectory | None:
    """Run that a folder or file belongs to; None if there is none."""
    home = path if path.is_dir() else path.parent
    return RunDirectory(home) if (home / "run.json").exists() else None


def _summary_of(path: Path) -> Summary | None:
    """Summary of the run that a file or folder belongs to; None if there is none."""
    run = run_of(path)
    if run is None or not (run / "summary.json").exists():
        return None
    return read_json_as(_SUMMARY, run / "summary.json", do="resume the run, which writes it again")
