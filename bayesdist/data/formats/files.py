"""Files named by a path, their formats, and the exposures that they represent."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from astropy.table import Table

from bayesdist.data.formats.hst1pass import is_hst1pass, is_matchup
from bayesdist.data.formats.record import SUFFIX
from bayesdist.errors import FormatError, InputError
from bayesdist.files.tables import TABLE_SUFFIXES, is_binary, is_fits, read_table
from bayesdist.files.text_tables import is_text_table
from bayesdist.files.unpacked import read_lines, without_codec
from bayesdist.plugin import mission_objects

PathLike = str | os.PathLike[str]

# columns of astrometry.net correspondences (`corr.fits`): detections and their index stars
CORR_COLUMNS = {"x": "field_x", "y": "field_y", "ra": "index_ra", "dec": "index_dec"}
FORMATS = ("auto", "table", "bayesdist", "hst1pass", "matchup", "astrometry.net")


@dataclass(frozen=True)
class MatchFormat:
    """Format of files of matches that a mission registers in `match_formats`.

    Parameters
    ----------
    recognizes : callable
        ``recognizes(path)`` is True if the file is of this format.
    read : callable
        ``read(path)`` returns the matches as a table with column names and units that
        `read_matches` recognises.
    """

    recognizes: Callable[[Path], bool]
    read: Callable[[Path], Table]


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
        raise InputError("no file fits the pattern", where=str(path), do="check the pattern")
    return matching_files


def kind_of(file: Path, columns: Mapping[str, str] | None) -> str:
    """Format of a file: one registered by a mission, or else by its name and then its content."""
    if columns is None and file.is_file():
        for key, format_ in mission_formats().items():
            if format_.recognizes(file):
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
    if is_matchup(lines):
        return "matchup"
    if is_hst1pass(file, lines):
        return "hst1pass"  # the reader reports what is wrong
    if is_text_table(lines) or is_fits(file):
        return "table"
    raise FormatError(
        "is of no known kind",
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
