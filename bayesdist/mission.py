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
    """What belongs to one mission, as "module:object" that is loaded when it is used.

    Parameters
    ----------
    title : str
        One line for `bayesdist --help`.
    commands : mapping of str to str
        Of the group that has the mission's name.
    simulate : mapping of str to str
        Of `bayesdist simulate`.
    beside_core : mapping of str to str
        Commands that stand beside those of the core.
    match_formats : mapping of str to str
        Formats of files of matches, by name: each a `bayesdist.data.MatchFormat`.
    data_sections : mapping of str to str
        Sections `[data]` of formats that have keys of their own, by the name of the format: each a
        subclass of `bayesdist.app.config.Data`.
    match_sources : mapping of str to str
        How the matches of these formats are read: each a
        `bayesdist.app.kinds.matches.sources.MatchSource`.
    error_terms : mapping of str to str
        Kinds of `[[budget]]` rows with one sigma: each makes an error term of name, kind, sigma,
        solution and source, as `bayesdist.assess.terms.parameters.ScaleError`.
    report : str
        Module that registers figures and tables with `bayesdist.report.contents.REPORT`.
    """

    title: str
    commands: Mapping[str, str] = field(default_factory=dict)
    simulate: Mapping[str, str] = field(default_factory=dict)
    beside_core: Mapping[str, str] = field(default_factory=dict)
    match_formats: Mapping[str, str] = field(default_factory=dict)
    data_sections: Mapping[str, str] = field(default_factory=dict)
    match_sources: Mapping[str, str] = field(default_factory=dict)
    error_terms: Mapping[str, str] = field(default_factory=dict)
    report: str = ""


@cache
def _entries() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in sorted(entry_points(group=GROUP))}


def mission_names() -> list[str]:
    """Names of all missions that are installed; none of them is loaded."""
    return list(_entries())


def load_mission(name: str) -> Mission:
    """Mission of this name.

    Raises
    ------
    InputError
        When its package cannot be loaded.
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
