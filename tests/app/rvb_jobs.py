"""RvB pairs of known truth as files, and configurations for them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from astropy.table import Table

from bayesdist.data.rvb.files import ARRAY_SIZE
from bayesdist.missions.wise.simulate import wise_solution
from tests.app.support import write_config

SIGMA = 0.1
DETECTORS = {band: {"name": band, "size": ARRAY_SIZE[band]} for band in ARRAY_SIZE}


def rvb_pairs(
    n: int = 600,
    band: str = "W4",
    *,
    seed: int = 1,
    half: float = 1.0,
    false: float = 0.03,
    circle: float | None = None,
) -> Table:
    """Pairs of one band by the published distortion.

    `half` is the covered part of each side; false matches are Gaussian about the expected position,
    1.5 px on each axis, or uniform in a circle.
    """
    rng = np.random.default_rng(seed)
    model, theta = wise_solution(band)
    size = np.array(ARRAY_SIZE[band])
    x, y = (s / 2 + 0.5 + half * s / 2 * rng.uniform(-1, 1, n) for s in size)
    offset = rng.normal(0, 1.5, (n, 2))
    if circle is not None:
        r, phi = circle * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
        offset = np.column_stack([r * np.cos(phi), r * np.sin(phi)])
    is_false = rng.uniform(size=n) < false
    error = np.where(is_false[:, None], offset, rng.normal(0, SIGMA, (n, 2)))
    u, v = (model.predict(theta, x, y) + error).T
    table = Table({"x": x, "y": y, "u": u, "v": v})
    table["sigma_u"] = table["sigma_v"] = np.full(n, SIGMA)
    table["frame"] = [f"0{k}a" for k in rng.integers(7, size=n)]
    table["band"] = np.full(n, band)
    table["mjd"] = 55200.0 + rng.integers(100, size=n)
    table["colour"] = np.where(rng.uniform(size=n) < 0.1, np.nan, rng.normal(0.2, 0.5, n))
    return table


def write_rvb_table(table: Table, path: Path) -> Path:
    """As the end of the name says: .tbl is an IPAC table."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".parquet":
        columns = {name: pa.array(np.asarray(table[name]).tolist()) for name in table.colnames}
        pq.write_table(pa.table(columns), path, row_group_size=250)
    else:
        table.write(path, format="ascii.ipac")
    return path


def rvb_job(folder: Path, table: Table, suffix: str = ".tbl", **sections: Any) -> Path:
    """pairs.tbl and config.toml in a folder; `data` adds to the section [data]."""
    path = write_rvb_table(table, folder / f"pairs{suffix}")
    data = {"matches": path.name, "format": "rvb", "columns": {"exposure": ""}}
    data |= sections.pop("data", {})
    data = {key: value for key, value in data.items() if value is not None}
    defaults: dict[str, Any] = {
        "detector": DETECTORS["W4"],
        "model": {"order": 2},
        "fit": {"clip_abs": 3.0},
    }
    return write_config(folder / "config.toml", data=data, **(defaults | sections))
