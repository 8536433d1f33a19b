"""Formats of matches that missions add."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from astropy.table import Table

from bayesdist.mission import load_object, missions

__all__ = ["MatchFormat", "mission_formats"]


@dataclass(frozen=True)
class MatchFormat:
    """A format of files of matches that a mission names in `match_formats`.

    Parameters
    ----------
    recognizes : callable
        Given the path of a file: whether it is of this format.
    read : callable
        Given the path: its matches as a table whose columns have the names and units that
        `read_matches` knows.
    """

    recognizes: Callable[[Path], bool]
    read: Callable[[Path], Table]


def mission_formats() -> dict[str, MatchFormat]:
    """Formats of all missions that are installed, by name."""
    return {
        name: load_object(where)
        for mission in missions().values()
        for name, where in mission.match_formats.items()
    }
