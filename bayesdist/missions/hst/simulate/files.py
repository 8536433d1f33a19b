"""Write and read a simulated campaign as a folder of files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.data import ReferenceCatalog, read_catalog
from bayesdist.data.exposures import ExposureLog, read_exposures, write_exposures
from bayesdist.data.starlists import read_star_lists
from bayesdist.data.tables.checks import columns_of
from bayesdist.data.writing import write_columns
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path, made_folder
from bayesdist.files.faults import naming_faults
from bayesdist.files.tables import read_table
from bayesdist.missions.hst.simulate.truth import (
    LINEAR_TERMS,
    AcsCampaign,
    AcsFrames,
    AcsTruth,
    DetectionTruth,
    TrueStars,
)
from bayesdist.model import DistortionModel
from bayesdist.model.grid import mesh
from bayesdist.model.lookup import LookupTable

CATALOGS = {"catalog": "catalog", "catalog_early": "early", "catalog_late": "late"}
CATALOG_UNITS = (
    dict.fromkeys(("u", "v", "sigma_u", "sigma_v"), "pix")
    | dict.fromkeys(("pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v"), "pix / yr")
    | {"epoch": "yr"}
)

README = """\
A simulated campaign of ACS/WFC on a field near 47 Tucanae, after ACS ISR 2015-06.
{settings}

Input of a calibration
----------------------
catalog.parquet        standard catalogue, one row for each star
    star               code of the star, its row from 0
    u, v               position at 2004.5, pixels of 50 mas on the tangent plane; u to the west,
                       v to the north; (5000, 5000) is 00h 22m 35.0s -72d 04' 00"
    sigma_u, sigma_v   errors of u, v
    pm_u, pm_v         proper motion, pixels per year; sigma_pm_u, sigma_pm_v are its errors
    mag                instrumental magnitude, -2.5 log10(flux / exposure time)
    epoch              decimal year of u, v
catalog_early.parquet, catalog_late.parquet
                       mean positions before and after Servicing Mission 4 (2009.4), with the mean
                       epoch of each star: proper motions may be derived from them
exposures.ecsv         one row for each exposure: epoch of the middle, filter, exptime (s),
                       vafactor, pa_v3, ra, dec (degrees; commanded values: true pointings differ by
                       some 0.5" and roll angles by some 0.003 degrees)
lists/*.parquet        raw detections of each exposure, in a file with its name
    x, y               FITS 1-based pixels of the chip
    chip               1 (WFC1) or 2 (WFC2)
    mag                instrumental magnitude, with a zero point of the exposure
    q                  quality of the fit: about the centroid error; poor for saturated stars
                       (brighter than -14) and for most false detections

Truth, in the folder truth/
---------------------------
theta.ecsv             true parameters of the distortion in each filter; its header contains the
                       model and the settings of the simulation
tables.parquet         look-up tables, one row for each node: chip, filter (empty: detector), x, y,
                       and dx, dy to be added to the pixel
stars.parquet          true positions at 2004.5, motions and magnitudes, rows as in the catalogue
exposures.ecsv         true frames, rows as in the log:
                       (u, v)_catalogue = (u, v) + vafactor R(angle) (I + shared) w, where w is the
                       polynomial, plus `own` times (x', y') on WFC1; linear terms A_1 ... B_3 of
                       each chip in the gauge of the report, including the exposure's deviations
detections.parquet     rows of all lists in the order of the log: exposure, star (row of the
                       catalogue; -1 for false detections), blended
"""


def write_acs(
    campaign: AcsCampaign, folder: str | os.PathLike[str], *, force: bool = False
) -> list[Path]:
    """Write a campaign and a README.txt that describes its files.

    Parameters
    ----------
    campaign : AcsCampaign
    folder : path-like
        Folder for the files, which is created if necessary.
    force : bool, optional
        True to replace an existing campaign.

    Returns
    -------
    list of pathlib.Path
        Input files of a calibration: the three catalogues, the log, and the star lists.

    Raises
    ------
    InputError
        If the folder contains a campaign already, or is not writable.
    """
    folder = Path(folder)
    _prepare(folder, force=force)
    out = []
    for name, attribute in CATALOGS.items():
        out.append(folder / f"{name}.parquet")
        _write_catalog(getattr(campaign, attribute), out[-1])
    out.append(folder / "exposures.ecsv")
    write_exposures(campaign.log, out[-1])
    for star_list in campaign.lists:
        out.append(folder / "lists" / f"{star_list.name}.parquet")
        columns = columns_of(star_list, ("x", "y", "chip", "mag", "q"))
        write_columns(out[-1], columns, {"x": "pix", "y": "pix"})
    write_truth(campaign.truth, folder / "truth")
    settings = ", ".join(f"{key} {value}" for key, value in campaign.truth.settings.items())
    with atomic_path(folder / "README.txt") as temporary:
        temporary.write_text(README.format(settings=settings), encoding="utf-8")
    return out


def read_acs(folder: str | os.PathLike[str]) -> AcsCampaign:
    """Read a campaign with its truth.

    Parameters
    ----------
    folder : path-like
        Folder that was written by `write_acs`.

    Returns
    -------
    AcsCampaign

    Raises
    ------
    InputError
        If a file is missing or damaged.
    """
    folder = Path(folder)
    catalogs = {
        attribute: read_catalog(folder / f"{name}.parquet") for name, attribute in CATALOGS.items()
    }
    log = read_exposures(folder / "exposures.ecsv")
    lists = read_star_lists([folder / "lists" / f"{name}.parquet" for name in log.names])
    return AcsCampaign(**catalogs, log=log, lists=lists, truth=read_truth(folder / "truth", log))


def _prepare(folder: Path, *, force: bool) -> None:
    lists = folder / "lists"
    old = sorted(lists.glob("*.parquet"))
    if old and not force:
        raise InputError(
            "the folder contains a campaign", where=str(folder), do="choose another, or replace it"
        )
    for path in (lists, folder / "truth"):
        made_folder(path)
    try:
        for path in (*old, folder / "truth" / "tables.parquet"):
            path.unlink(missing_ok=True)  # remove star lists of a previous campaign
    except OSError as error:
        raise InputError(
            f"the folder cannot be emptied ({error.strerror})",
            where=str(folder),
            do="choose one that is writable",
        ) from error


def _write_catalog(catalog: ReferenceCatalog, path: Path) -> None:
    names = (
        *("star", "u", "v", "sigma_u", "sigma_v"),
        *("pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v", "mag"),
    )
    columns = columns_of(catalog, names)
    columns["epoch"] = np.broadcast_to(np.asarray(catalog.epoch, float), (len(catalog),)).copy()
    write_columns(path, columns, CATALOG_UNITS)


# -- files of the truth ---------------------------------------------------------------------------


STAR_UNITS = {"u": "pix", "v": "pix", "pm_u": "pix / yr", "pm_v": "pix / yr"}
MATRIX = ("uu", "uv", "vu", "vv")


def write_truth(truth: AcsTruth, folder: Path) -> None:
    """Write the truth as theta.ecsv, exposures.ecsv, and stars, tables and detections.parquet."""
    theta = Table({"name": list(truth.model.names), "unit": list(truth.model.units)})
    for filter, values in truth.theta.items():
        theta[filter] = values
    theta.meta = {"model": truth.model.to_dict(), "settings": dict(truth.settings)}
    for table, name in ((theta, "theta.ecsv"), (_frames_table(truth), "exposures.ecsv")):
        with atomic_path(folder / name) as temporary:
            table.write(temporary, format="ascii.ecsv")
    stars = columns_of(truth.stars, ("u", "v", "pm_u", "pm_v", "mag"))
    write_columns(folder / "stars.parquet", stars, STAR_UNITS)
    if truth.tables:
        _write_tables(truth, folder / "tables.parquet")
    sizes = [len(detection_truth.star) for detection_truth in truth.detections]
    write_columns(
        folder / "detections.parquet",
        {
            "exposure": (np.repeat(np.arange(len(sizes)), sizes), truth.frames.names),
            "star": np.concatenate([detection_truth.star for detection_truth in truth.detections]),
            "blended": np.concatenate(
                [detection_truth.blended for detection_truth in truth.detections]
            ),
        },
        {},
    )


def read_truth(folder: Path, log: ExposureLog) -> AcsTruth:
    """Read the truth of a campaign that was written by `write_truth`.

    Raises InputError if a file is missing or damaged.
    """
    folder = Path(folder)
    theta = read_table(folder / "theta.ecsv")
    frames = read_table(folder / "exposures.ecsv")
    stars = read_table(folder / "stars.parquet")
    detections = read_table(folder / "detections.parquet")
    with naming_faults(folder):
        model = DistortionModel.from_dict(theta.meta["model"])
        settings = dict(theta.meta["settings"])
        names = tuple(str(name) for name in frames["exposure"])
        exposure = np.asarray(detections["exposure"]).astype(str)
        rows = [exposure == name for name in names]
        return AcsTruth(
            model=model,
            theta={f: np.array(theta[f]) for f in theta.colnames if f not in ("name", "unit")},
            tables=_read_tables(folder / "tables.parquet") if settings["fine_scale"] else (),
            stars=TrueStars(**{key: np.array(stars[key]) for key in stars.colnames}),
            log=log,
            frames=AcsFrames(
                names=names,
                centre=np.column_stack([frames["u"], frames["v"]]),
                angle=np.radians(frames["angle"]),
                vafactor=np.array(frames["vafactor"]),
                shared=_matrices(frames, "shared"),
                own=_matrices(frames, "own"),
                outlying=np.array(frames["outlying"], bool),
                zero_point=np.array(frames["zero_point"]),
            ),
            detections=tuple(
                DetectionTruth(
                    np.array(detections["star"][r]), np.array(detections["blended"][r], bool)
                )
                for r in rows
            ),
            settings=settings,
        )


def _frames_table(truth: AcsTruth) -> Table:
    """Table of the exposures: frames, deviations, and the resulting linear terms."""
    frames = truth.frames
    out = Table({"exposure": list(frames.names)})
    out["epoch"] = truth.log.values("epoch")
    out["u"], out["v"] = frames.centre.T
    out["angle"] = np.degrees(frames.angle)
    out["vafactor"] = frames.vafactor
    out["zero_point"] = frames.zero_point
    out["outlying"] = frames.outlying
    for name in ("shared", "own"):
        for key, values in zip(MATRIX, getattr(frames, name).reshape(-1, 4).T, strict=True):
            out[f"{name}_{key}"] = values
    for chip in truth.model.chips:
        terms = np.array([truth.linear_terms(name, chip.number) for name in frames.names])
        for key, values in zip(LINEAR_TERMS, terms.T, strict=True):
            out[f"{key}_{chip.name}"] = values
    for key, unit in (("epoch", "yr"), ("u", "pix"), ("v", "pix"), ("angle", "deg")):
        out[key].unit = unit
    return out


def _matrices(table: Table, name: str) -> np.ndarray:
    return np.column_stack([table[f"{name}_{key}"] for key in MATRIX]).reshape(-1, 2, 2)


def _write_tables(truth: AcsTruth, path: Path) -> None:
    """Write the look-up tables with one row per node."""
    rows: dict[str, list[Any]] = {key: [] for key in ("chip", "filter", "x", "y", "dx", "dy")}
    labels = tuple(dict.fromkeys(table.filter for table in truth.tables))
    for table in truth.tables:
        x, y = mesh(*table.nodes())
        rows["chip"].append(np.full(x.size, table.chip))
        rows["filter"].append(np.full(x.size, labels.index(table.filter)))
        rows["x"].append(x)
        rows["y"].append(y)
        rows["dx"].append(table.values[0].ravel())
        rows["dy"].append(table.values[1].ravel())
    columns: dict[str, Any] = {key: np.concatenate(parts) for key, parts in rows.items()}
    columns["filter"] = (columns["filter"], labels)
    write_columns(path, columns, dict.fromkeys(("x", "y", "dx", "dy"), "pix"))


def _read_tables(path: Path) -> tuple[LookupTable, ...]:
    stored = read_table(path)
    with naming_faults(path):
        chip, filter = np.asarray(stored["chip"]), np.asarray(stored["filter"]).astype(str)
        out = []
        for key in dict.fromkeys(zip(chip.tolist(), filter.tolist(), strict=True)):
            rows = stored[(chip == key[0]) & (filter == key[1])]
            x, y = np.unique(rows["x"]), np.unique(rows["y"])
            out.append(
                LookupTable(
                    chip=key[0],
                    values=np.stack([rows["dx"], rows["dy"]]).reshape(2, y.size, x.size),
                    filter=key[1],
                    first=(float(x[0]), float(y[0])),
                    step=(float(x[1] - x[0]), float(y[1] - y[0])),
                )
            )
    return tuple(out)
