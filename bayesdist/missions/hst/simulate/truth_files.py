"""Write and read the truth of a simulated campaign."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.data.exposures import ExposureLog
from bayesdist.data.storage import write_columns
from bayesdist.data.tables.checks import columns_of
from bayesdist.files.atomic import atomic_path
from bayesdist.files.faults import naming_faults
from bayesdist.files.tables import read_table
from bayesdist.missions.hst.simulate.pointings import AcsFrames
from bayesdist.missions.hst.simulate.stars import TrueStars
from bayesdist.missions.hst.simulate.truth import LINEAR_TERMS, AcsTruth, DetectionTruth
from bayesdist.model import DistortionModel
from bayesdist.model.grid import mesh
from bayesdist.model.lookup import LookupTable

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
