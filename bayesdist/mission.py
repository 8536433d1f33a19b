"""A mission: what a package adds to the command line for one instrument.

A package names it in its pyproject.toml, and it is found there::

    [project.entry-points."bayesdist.missions"]
    wise = "bayesdist.missions.wise:MISSION"
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from bayesdist.errors import InputError

__all__ = ["GROUP", "Mission", "load_mission", "mission_names", "missions"]

GROUP = "bayesdist.missions"


@dataclass(frozen=True)
class Mission:
    """What belongs to one mission; all commands are "module:object", loaded when they are used.

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
    """

    title: str
    commands: Mapping[str, str] = field(default_factory=dict)
    simulate: Mapping[str, str] = field(default_factory=dict)
    beside_core: Mapping[str, str] = field(default_factory=dict)


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
