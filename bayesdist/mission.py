"""A mission: what a package adds for one instrument, and how it is found.

A package names it in its pyproject.toml, and it is found there::

    [project.entry-points."bayesdist.missions"]
    wise = "bayesdist.missions.wise:MISSION"
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from bayesdist.errors import InputError

__all__ = ["GROUP", "Mission", "load_mission", "load_object", "mission_names", "missions"]

GROUP = "bayesdist.missions"


@dataclass(frozen=True)
class Mission:
    """What belongs to one mission, as "module:object" that is loaded when it is used."""

    title: str  # one line for `bayesdist --help`
    # of the group that has the mission's name
    commands: Mapping[str, str] = field(default_factory=dict)
    simulate: Mapping[str, str] = field(default_factory=dict)  # of `bayesdist simulate`
    # commands that stand beside those of the core
    beside_core: Mapping[str, str] = field(default_factory=dict)
    # formats of files of matches, by name: each a `bayesdist.data.MatchFormat`
    match_formats: Mapping[str, str] = field(default_factory=dict)
    # sections `[data]` of formats that have keys of their own, by the name of the format: each a
    # subclass of `bayesdist.app.config.Data`
    data_sections: Mapping[str, str] = field(default_factory=dict)
    # how the matches of these formats are read: each a
    # `bayesdist.app.kinds.matches.sources.MatchSource`
    match_sources: Mapping[str, str] = field(default_factory=dict)
    # kinds of `[[budget]]` rows with one sigma: each makes an error term of name, kind, sigma,
    # solution and source, as `bayesdist.assess.terms.parameters.ScaleError`
    error_terms: Mapping[str, str] = field(default_factory=dict)
    # module that registers figures and tables with `bayesdist.report.contents.REPORT`
    report: str = ""


@cache
def _entries() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in sorted(entry_points(group=GROUP))}


def mission_names() -> list[str]:
    """Names of all missions that are installed; none of them is loaded."""
    return list(_entries())


def load_mission(name: str) -> Mission:
    """Mission of this name.

    InputError when its package cannot be loaded.
    """
    entry = _entries()[name]
    try:
        found = entry.load()
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"the mission cannot be loaded ({error})",
            where=f"{name} = {entry.value}",
            do="install its package again, or remove it",
        ) from error
    if not isinstance(found, Mission):
        raise InputError("is no Mission", where=f"{name} = {entry.value}", do="mend its package")
    return found


def missions() -> dict[str, Mission]:
    """All missions that are installed, by name."""
    return {name: load_mission(name) for name in mission_names()}


def load_object(where: str) -> Any:
    """Object that "module:object" names."""
    module, _, name = where.partition(":")
    return getattr(import_module(module), name)
