"""Write simulated sets of pairs as partitioned Parquet, with their truth."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bayesdist.data.writing import Labelled, write_columns
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path, made_folder
from bayesdist.missions.wise.simulate.sets import PairChunk, PartitionPattern, WiseSet

UNITS = dict.fromkeys(("x", "y", "u", "v", "sigma"), "pix") | {"epoch": "yr", "mag": "mag"}
UNITS["colour"] = "mag"


def write_wise_set(
    one: WiseSet, folder: str | os.PathLike[str], *, threads: int = 2, force: bool = False
) -> int:
    """Write the pairs of a band and their truth.

    Each thread simulates and writes one chunk at a time, so that the memory is that of `threads`
    chunks.  The files do not depend on the number of threads.

    Parameters
    ----------
    one : WiseSet
    folder : path-like
        Folder for the files.  ``w1/part-00000.parquet`` etc. contain the pairs, with columns x, y,
        u, v, sigma, mag, colour, epoch, frame and band.  The files in ``truth/w1/`` have the same
        rows and state whether a pair is false.  ``truth/w1.ecsv`` contains the distortion, and
        ``truth/w1_pattern.ecsv`` the partition pattern, if any.
    threads : int, optional
        Number of threads.
    force : bool, optional
        True to replace an existing set of this band.

    Returns
    -------
    int
        Number of false matches.

    Raises
    ------
    InputError
        If the folders of the band contain files already, or are not writable.  Files that were
        written are then removed.
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
                "contains Parquet files already", where=str(folder), do="choose an empty folder"
            )
        path.unlink()


def _parts(one: WiseSet, folder: Path) -> list[Path]:
    return [folder / f"part-{k:05d}.parquet" for k in range(len(one.edges) - 1)]


def _written(
    one: WiseSet, pairs: Path, truth: Path, pool: ThreadPoolExecutor, threads: int
) -> Iterator[int]:
    """Write the parts in `threads` threads; yields the number of false matches of each part."""

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


def _columns(one: WiseSet, chunk: PairChunk) -> dict[str, NDArray[Any] | Labelled]:
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
    """Table with one row per axis and block; the subtracted polynomial is in the metadata."""
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
        "offset": "at the centre of a block; tilts: change from its centre to its edge",
        "sign": "of the WISE position: the pattern is subtracted from the reference position",
        "taken_off": {
            name: values.tolist() for name, values in zip("xy", pattern.smooth, strict=True)
        },
    }
    return table
