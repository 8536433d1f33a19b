"""Missions: plug-ins that add commands, formats and report sections for one instrument.

A package registers its `Mission` as an entry point in its pyproject.toml::

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

GROUP = "bayesdist.missions"


@dataclass(frozen=True)
class Mission:
    """Extensions for one mission, each given as "module:object" and imported on first use."""

    title: str  # one line for `bayesdist --help`
    # subcommands of `bayesdist NAME`, where NAME is the name of the entry point
    commands: Mapping[str, str] = field(default_factory=dict)
    simulate: Mapping[str, str] = field(default_factory=dict)  # of `bayesdist simulate`
    # commands at the top level, like those of the core
    beside_core: Mapping[str, str] = field(default_factory=dict)
    # file formats of matches, by name: each a `bayesdist.data.MatchFormat`
    match_formats: Mapping[str, str] = field(default_factory=dict)
    # format-specific keys of the section `[data]`, by the name of the format: each a subclass of
    # `bayesdist.app.config.Data`
    data_sections: Mapping[str, str] = field(default_factory=dict)
    # readers of these formats: each a `bayesdist.app.kinds.matches.sources.MatchSource`
    match_sources: Mapping[str, str] = field(default_factory=dict)
    # kinds of `[[budget]]` rows with one sigma: each a callable (name, kind, sigma, solution,
    # source) that returns an error term, such as `bayesdist.assess.terms.parameters.ScaleError`
    error_terms: Mapping[str, str] = field(default_factory=dict)
    # module that registers figures and tables with `bayesdist.report.contents.REPORT`
    report: str = ""


@cache
def _entries() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in sorted(entry_points(group=GROUP))}


def mission_names() -> list[str]:
    """Names of all installed missions, found without importing them."""
    return list(_entries())


def load_mission(name: str) -> Mission:
    """Import the mission of this name.

    Raises InputError if its package cannot be imported.
    """
    entry = _entries()[name]
    try:
        mission = entry.load()
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"the mission cannot be loaded ({error})",
            where=f"{name} = {entry.value}",
            do="install its package again, or remove it",
        ) from error
    if not isinstance(mission, Mission):
        raise InputError("is no Mission", where=f"{name} = {entry.value}", do="mend its package")
    return mission


def missions() -> dict[str, Mission]:
    """All installed missions by name, imported."""
    return {name: load_mission(name) for name in mission_names()}


def load_object(where: str) -> Any:
    """Import the object given as "module:object"."""
    module, _, name = where.partition(":")
    return getattr(import_module(module), name)
