"""Matches in an HDF5 file that stores every column and label exactly."""

from __future__ import annotations

from pathlib import Path

from bayesdist.data.matches import Matches
from bayesdist.files.records import read_record, write_record

SUFFIX = ".h5"


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
