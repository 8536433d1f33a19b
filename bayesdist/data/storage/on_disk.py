"""Matches that stay on disk: Parquet files, read batch by batch.

A scan with one block in memory at a time collects what must be known about all rows: the names of
exposures, chips and filters, and the tangent point. It also checks that no row is invalid or
repeated.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data import batches
from bayesdist.data.columns.checked import COLUMNS, POSITIONS, SIGMAS
from bayesdist.data.columns.labels import LABELS_OF_CODES, Labels
from bayesdist.data.formats.files import exposure_names, input_files
from bayesdist.data.matches import Matches
from bayesdist.data.reading.options import ReadOptions, refuse_missing_errors
from bayesdist.data.storage.stored import BLOCK, StoredFile, scan, stored_file, tangent_point_of
from bayesdist.data.tables.parquet import describe_part
from bayesdist.errors import FormatError, InputError

PathLike = str | os.PathLike[str]
Segment = tuple[int, int, int]  # file, first row, and row after the last


@dataclass(frozen=True, eq=False)
class StoredRows:
    """Consecutive rows of Parquet files."""

    labels: Labels
    files: tuple[StoredFile, ...]  # files of the rows
    # for each file: its code, the first row, and the row after the last
    segments: tuple[Segment, ...]

    def __len__(self) -> int:
        return sum(stop - start for _, start, stop in self.segments)

    def load(self) -> Matches:
        """Read the rows, with codes and sources that refer to the labels.

        InputError if a file is damaged, missing, or has changed since it was opened.
        """
        columns: dict[str, NDArray[Any]] = {}
        names, end = set(COLUMNS), 0
        for block in self._blocks():
            first, end = end, end + len(block["x"])
            names &= block.keys()
            for name in names:
                if first == 0:
                    columns[name] = np.empty(len(self), block[name].dtype)
                columns[name][first:end] = block[name]
        labels = self.labels.of_batch(len(self)).arguments()
        return Matches.of_distinct_rows(**{name: columns[name] for name in names}, **labels)

    def _blocks(self) -> Iterator[dict[str, NDArray[Any]]]:
        """Columns of the rows, block by block."""
        for file, (code, start, stop) in zip(self.files, self.segments, strict=True):
            row = start
            for block in file.blocks(start=start, stop=stop, size=BLOCK):
                out = {name: block[name] for name in COLUMNS if name in block}
                for key in LABELS_OF_CODES:
                    out[key] = self.labels.codes(key, block, source=file.source)
                out["row"] = np.arange(row, row + len(out["x"]))
                out["source"] = np.full(len(out["x"]), code)
                row += len(out["x"])
                yield out


def open_matches(path: PathLike | Sequence[PathLike], **options: Any) -> Matches:
    """Open matched star positions without reading them into memory.

    Parameters
    ----------
    path : path-like or sequence of path-like
        Parquet: a file, a list of files, a pattern, or a folder of parts of one table.
    **options
        As for `ReadOptions`; rows with missing values or values that are not finite are an error.

    Returns
    -------
    Matches
        Matches on disk; the batches are equal to `read_matches` of their rows.

    Raises
    ------
    InputError
        If a file or an option is invalid; the message says what to change. All files must have the
        same quantities, and some of them may be empty.

    Examples
    --------
    >>> from bayesdist.data import write_partitioned
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, _ = simulate_wise(500, rng=np.random.default_rng(1))
    >>> paths = write_partitioned([matches], "stars")
    >>> stars = bd.open_matches("stars")  # stays on disk
    >>> sum(len(batch) for batch in stars.batches())
    500
    """
    reading = ReadOptions(**options)
    if reading.not_finite == "reject":
        raise InputError(
            "rows of tables on disk cannot be left out in reading",
            where="data.not_finite",
            do="write the table without them",
        )
    if reading.plate_scale is not None:
        raise InputError(
            "tables on disk are not brought to another unit",
            where="data.plate_scale",
            do="write u, v and their errors in arcsec",
        )
    files = input_files(path)
    for file in files:
        if file.suffix.lower() != ".parquet":
            raise FormatError(
                "is no Parquet file, and others are read into memory",
                where=str(file),
                do="use read_matches",
            )
    in_parts = isinstance(path, str | os.PathLike) and Path(path).is_dir()
    names: Sequence[str | None] = [None] * len(files)
    if not in_parts and len(files) > 1:
        names = exposure_names(files)
    stored = [
        stored_file(describe_part(file), reading, exposure_name=name)
        for file, name in zip(files, names, strict=True)
    ]
    _refuse_differences(stored)
    first = stored[0]
    sigma = reading.sigma
    refuse_missing_errors(sigma, _has_errors(first), "mag" in first.found, where=first.source)
    if first.on_sky and reading.tangent_point is None:
        point = tangent_point_of(stored)
        stored = [
            replace(part, options=replace(part.options, tangent_point=point)) for part in stored
        ]
    labels = scan(stored)
    matches = Matches.from_readers(_readers(labels, stored), labels, _columns_of(first))
    return matches if isinstance(sigma, str) else matches.with_errors(sigma)


def _readers(labels: Labels, files: Sequence[StoredFile]) -> list[StoredRows]:
    """Consecutive rows of all files.

    Row groups and files are combined up to `BATCH` rows; larger ones are split evenly.
    """
    out: list[list[Segment]] = [[]]
    size = 0
    for code, file in enumerate(files):
        for start, stop in _spans(file.part.group_rows):
            if size + stop - start > batches.BATCH:
                out.append([])
                size = 0
            size += stop - start
            last = out[-1][-1] if out[-1] else None
            if last is not None and last[0] == code:
                out[-1][-1] = (code, last[1], stop)
            else:
                out[-1].append((code, start, stop))
    return [
        StoredRows(labels, tuple(files[code] for code, *_ in segments), tuple(segments))
        for segments in out
    ]


def _spans(group_rows: Sequence[int]) -> list[tuple[int, int]]:
    """First row and row after the last of each row group; large groups are split evenly."""
    out = []
    first = 0
    for rows in group_rows:
        edges = [first + edge for edge in batches.batch_edges(rows)]
        out += list(pairwise(edges))
        first += rows
    return out


def _columns_of(file: StoredFile) -> set[str]:
    """Columns of matches that a file provides."""
    available = set(file.found) & set(COLUMNS) | {*POSITIONS, *LABELS_OF_CODES, "row", "source"}
    if file.options.epoch is not None:
        available.add("epoch")
    if _has_errors(file):
        available |= set(SIGMAS)
    for on_sky, on_plane in (("pm_ra", "pm"), ("sigma_pm_ra", "sigma_pm")):
        if on_sky in file.found:
            available |= {f"{on_plane}_u", f"{on_plane}_v"}
    return available


def _refuse_differences(parts: Sequence[StoredFile]) -> None:
    """Raise InputError for parts that do not form one table."""
    first = parts[0]
    for part in parts[1:]:
        for lacking, having in ((part, first), (first, part)):
            missing = [key for key in having.found if key not in lacking.found]
            if missing:
                raise InputError(
                    f"has no column for {missing[0]!r}, but {having.source} has "
                    f"{having.found[missing[0]]!r}",
                    where=lacking.source,
                    do="give all parts the same columns",
                )
        if part.unit != first.unit:
            raise InputError(
                f"unit is {part.unit}, but {first.unit} in {first.source}",
                where=part.source,
                do="bring all files to one",
            )


def _has_errors(file: StoredFile) -> bool:
    """True if a file has errors of the matches, or of the reference positions."""
    return bool({"sigma_u", "sigma_ra"} & set(file.found))
