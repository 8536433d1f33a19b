"""Matches in one HDF5 file that keeps every column and label to the last bit."""

from __future__ import annotations

from pathlib import Path

from bayesdist.data.matches import Matches
from bayesdist.files.records import read_record, write_record

SUFFIX = ".h5"


def write_matches(path: Path, matches: Matches) -> None:
    """Write matches in memory to a file that `read_matches` reads.

    Parameters
    ----------
    path : pathlib.Path
        Name of the file, which ends in ``.h5``.
    matches : Matches

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    write_record(path, matches)


def read_written_matches(path: Path) -> Matches:
    """Matches of a file of `write_matches`.

    Raises
    ------
    FormatError
        If the file holds no matches.
    """
    return read_record(path, Matches, "a file of matches", do="restore it, or give a table")
