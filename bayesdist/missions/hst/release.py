"""Write a calibration as the complete set of files that the HST pipeline needs.

There is one IDCTAB per period, because a file holds only one drift; one D2IMFILE, because the
detector's pixels do not change; and one NPOLFILE per filter.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from bayesdist.app.config.results import ReleaseBlock
from bayesdist.app.products import ReleaseSet
from bayesdist.calibration.calibration import Calibration, calibration_of
from bayesdist.calibration.orientation import lay_on, oriented
from bayesdist.calibration.plane import Orientation
from bayesdist.errors import InputError
from bayesdist.files.atomic import made_folder, refuse_unsafe_name
from bayesdist.formats.idctab.build import idctab_from_solution
from bayesdist.formats.idctab.drift import Loss, storable
from bayesdist.formats.idctab.table import IdcTab, combination_of, read_idctab, write_idctab
from bayesdist.formats.lookup.file import read_lookup_file
from bayesdist.formats.lookup.tables import read_d2im, write_d2im, write_npol
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.solution.transforms import reference_gauge, without_frames
from bayesdist.model.lookup import LookupTable
from bayesdist.products.registry import lint, read_calibration

Filter = str | tuple[str, ...]

INSTRUMENT, DETECTOR = "ACS", "WFC"  # of files whose configuration names none
SCALE_ARCSEC = 0.05  # of their drizzled pixels


@dataclass(frozen=True)
class Period:
    """Range of dates covered by one IDCTAB.

    Parameters
    ----------
    name : str
        Part of the file name, such as "pre" or "post".
    years : tuple of float
        First and last date, decimal years.
    segment : int
        Segment of the solution's time dependence, counted from 0.
    useafter : str, optional
        USEAFTER, such as "Mar 01 2002 00:00:00".
    pedigree : str, optional
        PEDIGREE, such as "INFLIGHT 01/03/2002 01/05/2009".
    """

    name: str
    years: tuple[float, float]
    segment: int = 0
    useafter: str | None = None
    pedigree: str | None = None


@dataclass(frozen=True)
class Release:
    """Files that were written, and drifts that they could not store.

    Parameters
    ----------
    idctabs : dict of str to Path
        IDCTABs by the name of their period.
    d2im : Path or None
        D2IMFILE; None if there are no detector tables.
    npol : dict of str to Path
        NPOLFILEs by filter.
    lost : dict of str to tuple of Loss
        Drifts that could not be stored, with their size, by the name of the period.
    """

    idctabs: dict[str, Path]
    d2im: Path | None = None
    npol: dict[str, Path] = field(default_factory=dict)
    lost: dict[str, tuple[Loss, ...]] = field(default_factory=dict)

    @property
    def paths(self) -> list[Path]:
        """Paths of all files."""
        middle = [] if self.d2im is None else [self.d2im]
        return [*self.idctabs.values(), *middle, *self.npol.values()]


def write_release(
    folder: str | os.PathLike[str],
    name: str,
    calibrations: Mapping[str, Calibration],
    orientation: Orientation,
    periods: Sequence[Period],
    *,
    tables: Sequence[LookupTable] = (),
    stand_ins: Mapping[Filter, str] | None = None,
    instrument: str = "ACS",
    detector: str = "WFC",
    scale_arcsec: float = 0.05,
    limit_mas: float = 0.1,
    description: str = "Geometric distortion with its uncertainty, by bayesdist",
    history: Sequence[str] = (),
) -> Release:
    """Write <name>_<period>_idc.fits, <name>_d2i.fits and <name>_<filter>_npl.fits.

    Parameters
    ----------
    folder : path-like
        Output folder, which is created if it does not exist.
    name : str
        First part of all file names.
    calibrations : mapping of filter to Calibration
        Calibrations free of velocity aberration, with all segments, in the coordinate system of the
        orientation. The drift of the first calibration is stored, and must be valid for the others
        (see `storable`).
    orientation : Orientation
        Orientation of (u, v) in V2, V3.
    periods : sequence of Period
        One period for each IDCTAB.
    tables : sequence of LookupTable
        Tables of the detector (filter '') and of filters, at most one for each chip and filter.
    stand_ins : mapping of filter to filter, optional
        For each filter without a calibration, the filter that provides its rows. stwcs stops at an
        exposure if no row has its filters.
    instrument, detector : str
        INSTRUME and DETECTOR.
    scale_arcsec : float
        SCALE: size of the pixels onto which images are drizzled.
    limit_mas : float
        Largest drift that may be left out of a file.
    description : str
        DESCRIP of all files.
    history : sequence of str
        HISTORY lines of all files.

    Returns
    -------
    Release
        Paths of the files, and the drifts that were left out.

    Raises
    ------
    InputError
        If there is no filter or no period, if two periods have the same name, if a table or
        stand-in names a filter without a calibration, for the reasons given in `oriented`,
        `storable` and `idctab_from_solution`, or if a file cannot be written. No file is written
        unless all IDCTABs can be built.
    DegenerateError
        If the linear part of a chip is singular.
    """
    stand_ins = stand_ins or {}
    _check(calibrations, periods, tables, stand_ins)
    turned = {
        filter: oriented(calibration, orientation) for filter, calibration in calibrations.items()
    }
    built: dict[str, IdcTab] = {}
    lost: dict[str, tuple[Loss, ...]] = {}
    for period in periods:
        rows, losses = _stored(turned, period, limit_mas)
        lost[period.name] = tuple(
            entry for filter_losses in losses.values() for entry in filter_losses
        )
        notes = [
            f"{filter}: {entry}." if len(rows) > 1 else f"{entry}."
            for filter, filter_losses in losses.items()
            for entry in filter_losses
        ]
        served = {stand_in: rows[substitute] for stand_in, substitute in stand_ins.items()}
        built[period.name] = idctab_from_solution(
            rows | served,
            instrument=instrument,
            detector=detector,
            scale_arcsec=scale_arcsec,
            v2ref=orientation.v2v3[0],
            v3ref=orientation.v2v3[1],
            useafter=period.useafter,
            pedigree=period.pedigree,
            description=description,
            inverse=True,
            history=[
                f"For exposures from {period.years[0]:g} to {period.years[1]:g}.",
                *history,
                *notes,
            ],
        )

    folder = made_folder(folder)
    idctabs = {period: _path(folder, f"{name}_{period}_idc.fits", "the name") for period in built}
    for period_name, path in idctabs.items():
        write_idctab(built[period_name], path)
    first = periods[0]
    common: dict[str, Any] = {
        "description": description,
        "useafter": first.useafter,
        "pedigree": first.pedigree,
        "history": history,
    }
    detector_tables = [t for t in tables if not t.filter]
    d2im = None
    if detector_tables:
        d2im = _path(folder, f"{name}_d2i.fits", "the name")
        columns, lines = next(iter(calibrations.values())).model.chips[0].size
        size = (int(columns), int(lines))
        write_d2im(
            detector_tables, d2im, instrument=instrument, detector=detector, size=size, **common
        )
    npol = {}
    for filter in dict.fromkeys(t.filter for t in tables if t.filter):
        npol[filter] = _path(folder, f"{name}_{filter.lower()}_npl.fits", "the filter")
        write_npol(
            [t for t in tables if t.filter == filter],
            npol[filter],
            idctab=built[first.name],
            filters=combination_of(filter, instrument),
            **common,
        )
    return Release(idctabs, d2im, npol, lost)


def write_files(
    block: ReleaseBlock,
    chip: int,
    base: Path,
    folder: Path,
    solutions: Mapping[str, Solution],
    tables: Sequence[LookupTable],
    history: Sequence[str] = (),
) -> list[dict[str, Any]]:
    """Write the files of a release for one or several filters, as configured by one run.

    Parameters
    ----------
    block : ReleaseBlock
    chip : int
        Chip that defines the gauge by its axes and zero point.
    base : Path
        Folder that file names in the configuration are relative to.
    folder : Path
        Folder to write to.
    solutions : mapping of str to Solution
        Solutions by filter.  The first one must be that of the configuration: V2 and V3 are
        oriented as the reference states for it.
    tables : sequence of LookupTable
    history : sequence of str
        Lines for HISTORY in all files.

    Returns
    -------
    list of dict
        One entry per file: path, kind, findings and, for an IDCTAB, period and lost.
    """
    # only an IDCTAB has the V2 and V3 axes that the files are laid on
    read_idctab(base / block.reference)
    calibrations = {
        filter: calibration_of(
            reference_gauge(without_frames(solution), chip), filter, filter=filter
        )
        for filter, solution in solutions.items()
    }
    first = next(iter(calibrations.values()))
    time = first.model.time
    scale_arcsec = block.scale_arcsec or SCALE_ARCSEC
    orientation = lay_on(
        first,
        read_calibration(base / block.reference),
        chip=chip,
        epoch=None if time is None else time.epoch0[0],
        scale_arcsec=scale_arcsec,
    )
    written = write_release(
        folder,
        block.name,
        calibrations,
        orientation,
        [Period(**row.model_dump()) for row in block.period],
        tables=tables,
        instrument=block.instrument or INSTRUMENT,
        detector=block.detector or DETECTOR,
        scale_arcsec=scale_arcsec,
        limit_mas=block.limit_mas,
        history=history,
    )
    out: list[dict[str, Any]] = []
    for period, path in written.idctabs.items():
        lost = [asdict(row) for row in written.lost.get(period, ())]
        out.append(_entry(path, "IDCTAB") | {"period": period, "lost": lost})
    lookup_files = [] if written.d2im is None else [("D2IMFILE", written.d2im)]
    lookup_files += [("NPOLFILE", path) for path in written.npol.values()]
    return out + [_entry(path, kind) for kind, path in lookup_files]


def _entry(path: Path, kind: str) -> dict[str, Any]:
    findings = [f"{f.level}: {f.where}: {f.message}" for f in lint(path)]
    return {"path": path.name, "kind": kind, "findings": findings}


def _path(folder: Path, name: str, source: str) -> Path:
    """Path of a file of the release; `source` names the part of its name in the error message."""
    refuse_unsafe_name(name, where=f"{source} of the release")
    return folder / name


def _stored(
    calibrations: Mapping[str, Calibration], period: Period, limit_mas: float
) -> tuple[dict[Filter, Calibration], dict[Filter, tuple[Loss, ...]]]:
    """Calibrations of a period with the drift of the first one, and the losses, by filter."""
    rows: dict[Filter, Calibration] = {}
    lost: dict[Filter, tuple[Loss, ...]] = {}
    for filter, calibration in calibrations.items():
        rows[filter], lost[filter] = storable(
            calibration,
            years=period.years,
            segment=period.segment,
            limit_mas=limit_mas,
            like=next(iter(rows.values()), None),
        )
    return rows, lost


def _check(
    calibrations: Mapping[str, Calibration],
    periods: Sequence[Period],
    tables: Sequence[LookupTable],
    stand_ins: Mapping[Filter, str],
) -> None:
    if not calibrations:
        raise InputError("no filter is given", where="solutions", do="give at least one")
    if not periods:
        raise InputError("no period is given", where="periods", do="give one for each IDCTAB")
    names = [period.name for period in periods]
    if len(set(names)) < len(names):
        raise InputError(
            "two periods have the same name", where="periods", do="give each a different name"
        )
    available = f"solutions are given for {', '.join(map(str, calibrations))}"
    for table in tables:
        if table.filter and table.filter not in calibrations:
            raise InputError(
                f"the look-up table {table.label} is of a filter without a solution",
                where="tables",
                do=available,
            )
    for filter, stand_in in stand_ins.items():
        if stand_in not in calibrations:
            raise InputError(
                f"{stand_in!r} is to replace {filter!r}, but has no solution",
                where="stand_ins",
                do=available,
            )


def read_calibrations(
    entries: Sequence[Mapping[str, Any]], folder: Path, filter: str
) -> dict[str, Calibration]:
    """Read the calibrations of a filter, with look-up tables, from the files of a release.

    `entries` describe the files: their kind, path in `folder` and period. The result has one
    calibration per period, by its name.
    """
    paths = {entry["kind"]: folder / entry["path"] for entry in entries}
    before = read_d2im(paths["D2IMFILE"]) if "D2IMFILE" in paths else ()
    npol = read_lookup_file(paths["NPOLFILE"]) if "NPOLFILE" in paths else None
    sets = {}
    for entry in entries:
        if entry["kind"] == "IDCTAB":
            calibration = read_calibration(folder / entry["path"], filter=filter)
            tables = [] if npol is None else [npol.table(chip) for chip in npol.chips]
            pixel = calibration.pixel()[0]
            after = [replace(table, values=pixel * table.values, sigma=None) for table in tables]
            sets[entry["period"]] = replace(calibration, before=tuple(before), after=tuple(after))
    return sets


RELEASE = ReleaseSet(
    write_files,
    read_calibrations,
    kinds={
        "IDCTAB": "IDCTAB: polynomial and its drift",
        "D2IMFILE": "D2IMFILE: tables of the detector",
        "NPOLFILE": "NPOLFILE: tables of the filter",
    },
)
