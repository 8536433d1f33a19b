"""Matches as a section [data] names them, those of the formats of missions among them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from bayesdist.app.config import ChipBlock, Data
from bayesdist.app.kinds.matches.reading import load_matches, reading_options
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data import Matches
from bayesdist.mission import load_object, missions

__all__ = [
    "MatchSource",
    "RunInput",
    "input_of_run",
    "mission_template",
    "read_configured",
]

Paths = str | Path | Sequence[str | Path]
Template = tuple[int, dict[str, object]]


class RunInput(Protocol):
    """Matches of a run that may have to be written before they can be used."""

    def load(self) -> Matches:
        """All matches that the configuration selects."""

    def move_into_run(self) -> bool:
        """Truth of matches that were moved into the folder of the run, which has begun."""

    def close(self) -> None:
        """Remove what was not moved."""


@dataclass(frozen=True)
class MatchSource:
    """Reader of the matches of one format.

    Parameters
    ----------
    read : callable
        Of paths, the section [data] as the mission has it, and columns and rows of the detector:
        the matches in memory.
    input_of : callable
        Of the folder of a run: its `RunInput`.
    template : callable
        Of a path that `bayesdist init` is given: the number of matches and what they put into the
        template of a configuration; None where the files are of another format.
    """

    read: Callable[[Paths, Any, tuple[float, float]], Matches]
    input_of: Callable[[RunDirectory], RunInput]
    template: Callable[[str | Path], Template | None]


def _sources() -> dict[str, str]:
    """Where the sources of all missions are, by the name of the format."""
    return {name: where for one in missions().values() for name, where in one.match_sources.items()}


def _source(name: str) -> MatchSource | None:
    """Source of a format; None for the formats of the core."""
    where = _sources().get(name)
    return None if where is None else load_object(where)


def input_of_run(run: RunDirectory) -> RunInput | None:
    """Input of a run whose format a mission reads; None for all others."""
    data = run.config.data
    source = None if data is None else _source(data.format)
    return None if source is None else source.input_of(run)


def read_configured(
    path: Paths,
    data: Data,
    *,
    size: tuple[float, float] | None,
    chips: Sequence[ChipBlock],
) -> Matches:
    """Matches as a section [data] reads them; `size` is columns and rows of a single chip."""
    source = _source(data.format)
    if source is not None and size is not None:
        return source.read(path, data, size)
    return load_matches(path, **reading_options(data, chips))


def mission_template(matches: str | Path) -> Template | None:
    """Number of matches and their part of a template, where a mission knows the files."""
    for name in _sources():
        source = _source(name)
        found = None if source is None else source.template(matches)
        if found is not None:
            return found
    return None
