"""Sets of pairs as partitioned Parquet, with their truth."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.data.storage.write import write_columns
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path, made_folder
from bayesdist.missions.wise.simulate.pattern import PartitionPattern
from bayesdist.missions.wise.simulate.sets import PairChunk, WiseSet

UNITS = dict.fromkeys(("x", "y", "u", "v", "sigma"), "pix") | {"epoch": "yr", "mag": "mag"}
UNITS["colour"] = "mag"


def write_wise_set(
    one: WiseSet, folder: str | os.PathLike[str], *, threads: int = 2, force: bool = False
) -> int:
    """Write the pairs of a band, and their truth.

    Chunks are made and written in as many threads as are asked for; memory is that of so many
    chunks.  The files do not depend on their number.

    Parameters
    ----------
    one : WiseSet
    folder : path-like
        ``w1/part-00000.parquet`` and so on hold the pairs, with columns x, y, u, v, sigma, mag,
        colour, epoch, frame, band; ``truth/w1/`` of each pair True if it is false, in the same
        files and rows; ``truth/w1.ecsv`` the distortion; ``truth/w1_pattern.ecsv`` the partition
        pattern, where there is one.
    threads : int, optional
    force : bool, optional
        Replace a set of this band.

    Returns
    -------
    int
        Number of false matches.

    Raises
    ------
    InputError
        When the folders of the band are in use, or cannot be made or written; the parts that were
        written are removed then.
    """
    band = one.band.lower()
    pairs, truth = Path(folder) / band, Path(folder) / "truth" / band
    for each in (pairs, truth):
        _make_empty(each, force)
    (truth.parent / f"{band}_pattern.ecsv").unlink(missing_ok=True)
    try:
        with ThreadPoolExecutor(threads) as pool:
            n_false = sum(_written(one, pairs, truth, pool, threads))
        _write_truth(one, n_false, truth.parent)
    except BaseException:
        for name in (path.name for path in _parts(one, pairs)):
            (pairs / name).unlink(missing_ok=True)
            (truth / name).unlink(missing_ok=True)
        raise
    return n_false


def _make_empty(folder: Path, force: bool) -> None:
    made_folder(folder)
    for path in folder.glob("*.parquet"):
        if not force:
            raise InputError(
                "holds Parquet files already", where=str(folder), do="choose an empty folder"
            )
        path.unlink()


def _parts(one: WiseSet, folder: Path) -> list[Path]:
    return [folder / f"part-{k:05d}.parquet" for k in range(len(one.edges) - 1)]


def _written(
    one: WiseSet, pairs: Path, truth: Path, pool: ThreadPoolExecutor, threads: int
) -> Iterator[int]:
    """Number of false matches of each part, once it is written; `threads` parts are in work."""

    def write(k: int, path: Path) -> int:
        chunk = one.chunk(k)
        write_columns(path, _columns(one, chunk), UNITS)
        write_columns(truth / path.name, {"false": chunk.false}, {})
        return int(chunk.false.sum())

    jobs = (pool.submit(write, k, path) for k, path in enumerate(_parts(one, pairs)))
    waiting: list[Future[int]] = list(islice(jobs, threads))
    try:
        while waiting:
            yield waiting.pop(0).result()
            waiting += islice(jobs, 1)
    finally:
        for job in waiting:
            job.cancel()


def _columns(one: WiseSet, chunk: PairChunk) -> dict[str, Any]:
    first, last = int(chunk.frame[0]), int(chunk.frame[-1])
    names = one.survey.names[first : last + 1]
    return {
        "x": chunk.x,
        "y": chunk.y,
        "u": chunk.u,
        "v": chunk.v,
        "sigma": chunk.sigma,
        "mag": chunk.mag,
        "colour": chunk.colour,
        "epoch": one.survey.epoch[chunk.frame],
        "frame": (chunk.frame - first, names),
        "band": (np.zeros(len(chunk), np.int64), (one.band,)),
    }


def _write_truth(one: WiseSet, n_false: int, folder: Path) -> None:
    table = Table({"name": list(one.model.names), "value": one.theta})
    table.meta = {
        "band": one.band,
        "pairs": one.pairs,
        "false_matches": n_false,
        "seed": one.seed,
        "false_fraction": one.false_fraction,
        "unlisted_share": one.false_matches.unlisted,
        "partition_blocks": 0 if one.pattern is None else one.pattern.blocks,
        "model": one.model.to_dict(),
    }
    tables = {f"{one.band.lower()}.ecsv": table}
    if one.pattern is not None:
        tables[f"{one.band.lower()}_pattern.ecsv"] = _pattern_table(one.pattern)
    for name, each in tables.items():
        with atomic_path(folder / name) as temporary:
            each.write(temporary, format="ascii.ecsv")


def _pattern_table(pattern: PartitionPattern) -> Table:
    """Table of the axes and blocks; the polynomial that is subtracted is in the meta-data."""
    axis, row, column = (index.ravel() for index in np.indices(pattern.local.shape[:3]))
    table = Table(
        {
            "axis": np.array(["x", "y"])[axis],
            "row": row + 1,
            "column": column + 1,
            **{
                name: pattern.local[..., k].ravel()
                for k, name in enumerate(("offset", "tilt_x", "tilt_y"))
            },
        }
    )
    for name in ("offset", "tilt_x", "tilt_y"):
        table[name].unit = "pix"
    table.meta = {
        "offset": "at the centre of a block; tilts: the change from its centre to its edge",
        "sign": "of the WISE position: the pattern is taken from the reference position",
        "taken_off": {
            name: values.tolist() for name, values in zip("xy", pattern.smooth, strict=True)
        },
    }
    return table
