"""Files of matches: paths, formats, exposure names, and the interpretation of their columns.

The interpretation of the columns of a table can be shown and saved before the table is read.
`write_matches` writes an HDF5 file that stores every column and label of matches exactly.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.data.matches import Matches
from bayesdist.data.reading.columns import lacking_columns, present_columns
from bayesdist.data.reading.table import own_epoch, with_sky_columns
from bayesdist.data.tables.column import TableColumns
from bayesdist.data.tables.names import origin_of
from bayesdist.data.tables.parquet import describe_part
from bayesdist.errors import FormatError, InputError
from bayesdist.files.hdf5 import read_record, write_record
from bayesdist.files.tables import TABLE_SUFFIXES, is_binary, is_fits, read_table
from bayesdist.files.text_tables import is_text_table
from bayesdist.files.unpacked import read_lines, without_codec
from bayesdist.plugin import mission_objects

PathLike = str | os.PathLike[str]
# columns of astrometry.net correspondences (`corr.fits`): detections and their index stars
CORR_COLUMNS = {"x": "field_x", "y": "field_y", "ra": "index_ra", "dec": "index_dec"}
FORMATS = ("auto", "table", "bayesdist", "astrometry.net")
MAX_ROWS_READ = 200_000  # rows of a large table that are read to interpret its columns
MAX_CHIPS = 200
MIN_ROWS_ON_CHIP = 20  # rows; flags and qualities often have rarer values
SUFFIX = ".h5"


@dataclass(frozen=True)
class MatchFormat:
    """Format of files of matches or star lists that a mission registers in `match_formats`.

    Files have matches (`read`), or raw and corrected positions of one exposure (`detections` and
    `matches`), or are catalogues to which such lists are matched (`master` and `lists`).

    Parameters
    ----------
    recognizes : callable
        ``recognizes(path)`` is True if the file is of this format.
    read : callable, optional
        ``read(path)`` returns the matches as a table with column names and units that
        `read_matches` recognises.
    detections : callable, optional
        ``detections(path, name)`` returns the `Detections` of an exposure with this name.
    matches : callable, optional
        ``matches(path, name)`` returns the `Matches` of the detections with the corrected positions
        of the same list, in pixels.
    lacking : callable, optional
        ``lacking(path)`` returns those of "u" and "v" that the list does not have.
    master : callable, optional
        ``master(path)`` returns a `ReferenceCatalog` in pixels.
    lists : str
        Name of the format of the lists that are matched to the master.
    """

    recognizes: Callable[[Path], bool]
    read: Callable[[Path], Table] | None = None
    detections: Callable[[Path, str], Detections] | None = None
    matches: Callable[[Path, str | None], Matches] | None = None
    lacking: Callable[[Path], list[str]] | None = None
    master: Callable[[Path], ReferenceCatalog] | None = None
    lists: str = ""


def mission_formats() -> dict[str, MatchFormat]:
    """Formats of all installed missions, by name."""
    return mission_objects(lambda mission: mission.match_formats)


def input_files(path: PathLike | Sequence[PathLike]) -> list[Path]:
    """Files named by a path, a pattern, a folder, or a list of these.

    Parameters
    ----------
    path : path-like or sequence of path-like
        A pattern (``*``, ``?``, ``[``) stands for all files that match it, and a folder for the
        Parquet files in it and its subfolders, both sorted by name.

    Returns
    -------
    list of pathlib.Path
        Names of the files.

    Raises
    ------
    InputError
        If there are no files, or if a file is repeated.
    """
    paths = [path] if isinstance(path, str | os.PathLike) else list(path)
    if not paths:
        raise InputError("no file is named", where="data.matches", do="name at least one")
    files = [file for item in paths for file in _expanded(Path(item))]
    for file in files:
        if files.count(file) > 1:
            raise InputError("is named twice", where=str(file), do="name each file once")
    return files


def _expanded(path: Path) -> list[Path]:
    if path.is_dir():
        matching_files = sorted(
            file for file in path.rglob("*.parquet") if not file.name.startswith((".", "_"))
        )
        if not matching_files:
            raise InputError(
                "is a folder without Parquet files", where=str(path), do="name the files"
            )
        return matching_files
    if path.exists() or not glob.has_magic(str(path)):
        return [path]
    matching_files = sorted(Path(file) for file in glob.glob(str(path), recursive=True))  # noqa: PTH207  from any root
    if not matching_files:
        raise InputError("no file matches the pattern", where=str(path), do="check the pattern")
    return matching_files


def kind_of(file: Path, columns: Mapping[str, str] | None) -> str:
    """Format of a file: one registered by a mission, otherwise by its name and then its content.

    Raises FormatError if the format is not recognised.
    """
    formats = mission_formats()
    if columns is None and file.is_file():
        for key, format_ in formats.items():
            if format_.read is not None and format_.recognizes(file):
                return key
    name = without_codec(file.name)
    if name.endswith(tuple(TABLE_SUFFIXES)):
        if columns is None and name.endswith((".fits", ".fit")):
            corr = set(CORR_COLUMNS.values()) <= set(read_table(file).colnames)
            return "astrometry.net" if corr else "table"
        return "table"
    lines = [] if is_binary(file) else read_lines(file)
    if name.endswith(SUFFIX):
        return "bayesdist"
    for key, format_ in formats.items():
        if format_.read is None and format_.recognizes(file):
            return key  # the reader reports what is wrong
    if is_text_table(lines) or is_fits(file):
        return "table"
    raise FormatError(
        "is of an unknown kind",
        where=str(file),
        do="name its columns in its first line, or give a file that ends in "
        + ", ".join(TABLE_SUFFIXES),
    )


def exposure_names(files: Sequence[Path]) -> list[str]:
    """Exposure names of files: the stem, preceded by as many folders as make the names unique."""
    stems = [file.name.split(".")[0] or file.name for file in files]
    parents = [file.parent for file in files]
    while len(set(stems)) < len(stems):
        repeated = {stem for stem in stems if stems.count(stem) > 1}
        named = [
            f"{parent.name}/{stem}" if stem in repeated and parent.name else stem
            for stem, parent in zip(stems, parents, strict=True)
        ]
        if named == stems:  # only the extensions differ
            return [str(file) for file in files]
        stems, parents = named, [parent.parent for parent in parents]
    return stems


@dataclass(frozen=True)
class TableLayout:
    """Columns of a table, and their interpretation."""

    names: tuple[str, ...]  # all columns
    taken: dict[str, str]  # column of each quantity that is read
    origin: int  # coordinate of the first pixel, from column names and header
    why: str  # reason for the origin; empty if there is none
    like_chips: dict[str, int]  # number of distinct values in unused columns that may hold chips
    dated: bool  # True if the header has the date of the exposure
    spans: dict[str, tuple[float, float]]  # smallest and largest value of unused numeric columns
    # smallest and largest epoch of the reference positions; None without a column of numbers
    catalogue_epochs: tuple[float, float] | None = None

    @property
    def lacking(self) -> list[str]:
        """Quantities that matches need and that have no recognised column."""
        return lacking_columns(self.taken)


def table_layout(
    path: PathLike | Sequence[PathLike],
    columns: Mapping[str, str] | None = None,
    *,
    read_sigma: bool = True,
) -> TableLayout | None:
    """Layout of a file of matches; None for a format with fixed columns.

    If `path` has several files, the first one is described.  Arguments and errors are as for
    `read_matches`, except that columns may be missing.  `read_sigma` is True if columns of errors
    are read.
    """
    file = input_files(path)[0]
    if kind_of(file, columns) != "table":
        return None
    if file.suffix.lower() == ".parquet":
        part = describe_part(file)
        if not part.n_rows:
            raise InputError("holds no rows", where=str(file), do="give a table with stars")
        table: TableColumns = next(part.blocks(part.colnames, size=MAX_ROWS_READ))
        header: Mapping[str, Any] = {}
    else:
        full_table = with_sky_columns(read_table(file))
        table, header = full_table, full_table.meta
    names = tuple(table.colnames)
    taken = present_columns(names, columns, source=str(file), read_sigma=read_sigma)
    origin, why = origin_of(taken.get("x", ""), names, header)
    unused = {name: table[name] for name in names if name not in taken.values()}
    return TableLayout(
        names,
        taken,
        origin,
        why,
        {name: n for name, column in unused.items() if (n := _values_like_chips(column))},
        own_epoch(header) is not None,
        {name: span for name, column in unused.items() if (span := _span(column)) is not None},
        _span(table[taken["catalogue_epoch"]]) if "catalogue_epoch" in taken else None,
    )


def _span(column: Any) -> tuple[float, float] | None:
    """Smallest and largest value of a numeric column; None for other columns."""
    values = np.ma.compressed(np.ma.asarray(getattr(column, "value", column)))
    if values.dtype.kind not in "iuf":
        return None
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if finite.size else None


def _values_like_chips(column: Any) -> int:
    """Number of distinct values if they may be chips, otherwise 0."""
    values = np.asarray(getattr(column, "unmasked", column))
    if values.ndim != 1 or values.dtype.kind not in "iuSU" or getattr(column, "unit", None):
        return 0
    unique, counts = np.unique(values, return_counts=True)
    if not 2 <= len(unique) <= MAX_CHIPS or counts.min() < MIN_ROWS_ON_CHIP:
        return 0
    return len(unique)


def write_matches(path: Path, matches: Matches) -> None:
    """Write matches in memory to a file that `read_matches` can read.

    Parameters
    ----------
    path : pathlib.Path
        Output file, with a name that ends in ``.h5``.
    matches : Matches
        Matches in memory.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    write_record(path, matches)


def read_written_matches(path: Path) -> Matches:
    """Read matches from a file written by `write_matches`.

    Parameters
    ----------
    path : pathlib.Path
        HDF5 file.

    Returns
    -------
    Matches
        Matches in memory.

    Raises
    ------
    FormatError
        If the file holds no matches.
    """
    return read_record(path, Matches, "a file of matches", do="restore it, or give a table")
