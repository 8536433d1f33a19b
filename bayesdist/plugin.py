"""Plugins: kinds of runs, file formats and missions of this and of other packages.

A package registers a `Plugin` as an entry point in its pyproject.toml, as this one does::

    [project.entry-points."bayesdist.plugins"]
    wise = "bayesdist.missions.wise:PLUGIN"

The environment variable BAYESDIST_PLUGINS restricts the plugins to those with the given names,
separated by commas; none are used if it is empty.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from bayesdist.errors import BayesdistWarning

GROUP = "bayesdist.plugins"
SELECTION = "BAYESDIST_PLUGINS"  # environment variable


@dataclass(frozen=True)
class Mission:
    """Extensions for one mission, each given as "module:object" and imported on first use."""

    title: str  # one line for `bayesdist --help`
    # subcommands of `bayesdist NAME`, where NAME is the name of the mission
    commands: Mapping[str, str] = field(default_factory=dict)
    simulate: Mapping[str, str] = field(default_factory=dict)  # of `bayesdist simulate`
    # commands at the top level, like those of the core
    beside_core: Mapping[str, str] = field(default_factory=dict)
    # file formats of matches, by name: each a `bayesdist.data.MatchFormat`
    match_formats: Mapping[str, str] = field(default_factory=dict)
    # format-specific keys of the section `[data]`, by the name of the format: each a subclass of
    # `bayesdist.kinds.matches.config.Data`
    data_sections: Mapping[str, str] = field(default_factory=dict)
    # readers of these formats: each a `bayesdist.kinds.matches.sources.MatchSource`
    match_sources: Mapping[str, str] = field(default_factory=dict)
    # kinds of `[[budget]]` rows with one sigma: each a callable (name, kind, sigma, solution,
    # source) that returns an error term, such as `bayesdist.assess.terms.parameters.ScaleError`
    error_terms: Mapping[str, str] = field(default_factory=dict)
    # sets of files for [products.release]: each a `bayesdist.app.products.ReleaseSet`
    releases: Mapping[str, str] = field(default_factory=dict)
    # further checks of files, by the key of their format, which defines the arguments: for "sip" a
    # `bayesdist.formats.sip.lint.Explanation`
    checks: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Plugin:
    """Extensions by one package, each given as "module:object" and imported on first use.

    Parameters
    ----------
    kinds : mapping of str to str
        Kinds of runs by the section of the configuration that they begin with; each object is the
        class of that configuration, a subclass of `bayesdist.app.config.StarsConfig`.
    formats : mapping of str to str
        Formats of calibration files by key; each object is a
        `bayesdist.products.common.document.Format`.
    missions : mapping of str to Mission
        Missions by name, which is also the name of their command.
    commands : mapping of str to str
        Commands at the top level, like those of the core, for kinds of runs that have some; each
        object is a `click.Command`.
    first_commands : mapping of str to str
        Such commands that help lists before those of the core, because a run begins with them.
    reports : tuple of str
        Modules that register figures, tables and sections with `bayesdist.report.contents.REPORT`.
    """

    kinds: Mapping[str, str] = field(default_factory=dict)
    formats: Mapping[str, str] = field(default_factory=dict)
    missions: Mapping[str, Mission] = field(default_factory=dict)
    commands: Mapping[str, str] = field(default_factory=dict)
    first_commands: Mapping[str, str] = field(default_factory=dict)
    reports: tuple[str, ...] = ()


@cache
def plugins() -> dict[str, Plugin]:
    """All installed plugins by name of their entry point.

    A plugin that cannot be imported is left out with a warning.
    """
    loaded = {}
    for entry in _entries():
        plugin = _attempt(entry.name, entry.value, entry.load)
        if isinstance(plugin, Plugin):
            loaded[entry.name] = plugin
        elif plugin is not None:
            _warn(entry.name, entry.value, "it is not a bayesdist.plugin.Plugin")
    return loaded


def packages() -> frozenset[str]:
    """Names of the top-level packages that define plugins."""
    return frozenset(entry.module.partition(".")[0] for entry in _entries())


def missions() -> dict[str, Mission]:
    """Missions of all plugins, by name."""
    return {
        name: mission for plugin in plugins().values() for name, mission in plugin.missions.items()
    }


def objects(
    targets: Callable[[Plugin], Mapping[str, str]], *, flaw: Callable[[Any], str] = lambda _: ""
) -> dict[str, Any]:
    """Import the objects that plugins give in one of their fields.

    Parameters
    ----------
    targets : callable
        ``targets(plugin)`` returns "module:object" by name, such as ``plugin.formats``.
    flaw : callable
        ``flaw(object)`` returns why an object cannot be used, as a clause; empty if it can.

    Returns
    -------
    dict
        Objects by name. Those that cannot be imported or used are left out with a warning.
    """
    return dict(_loaded({name: targets(plugin) for name, plugin in plugins().items()}, flaw))


def mission_objects(
    targets: Callable[[Mission], Mapping[str, str]], *, only: str | None = None
) -> dict[str, Any]:
    """Import the objects that missions give in one of their fields; see `objects`.

    With `only`, the object of this name alone is imported.
    """
    by_mission = {
        name: {key: where for key, where in targets(mission).items() if only in (None, key)}
        for name, mission in missions().items()
    }
    return dict(_loaded(by_mission))


def import_reports() -> None:
    """Import the modules of plugins that register figures and tables of the report."""
    for name, plugin in plugins().items():
        for module in plugin.reports:
            _attempt(name, module, partial(import_module, module))


def load_object(where: str) -> Any:
    """Import the object given as "module:object"."""
    module, _, name = where.partition(":")
    return getattr(import_module(module), name)


def _entries() -> list[EntryPoint]:
    """Entry points of all plugins that BAYESDIST_PLUGINS does not exclude, sorted by name."""
    selected = os.environ.get(SELECTION)
    names = None if selected is None else {name.strip() for name in selected.split(",")}
    entries = sorted(entry_points(group=GROUP), key=lambda entry: (entry.name, entry.value))
    return [entry for entry in entries if names is None or entry.name in names]


def _loaded(
    targets: Mapping[str, Mapping[str, str]], flaw: Callable[[Any], str] = lambda _: ""
) -> Iterator[tuple[str, Any]]:
    """Names and objects by the names of their plugins, without those that cannot be used."""
    for plugin, by_name in targets.items():
        for name, where in by_name.items():
            loaded = _attempt(plugin, where, partial(load_object, where))
            if loaded is None:
                continue
            if reason := flaw(loaded):
                _warn(plugin, where, reason)
            else:
                yield name, loaded


def _attempt(name: str, where: str, load: Callable[[], Any]) -> Any:
    """Object of a plugin; None if it cannot be loaded, for whatever reason."""
    try:
        return load()
    except Exception as error:  # the code of another package may raise anything
        _warn(name, where, str(error) or type(error).__name__)
        return None


@cache  # once per plugin and reason
def _warn(name: str, where: str, cause: str) -> None:
    reason = " ".join(cause.split()).rstrip(".")
    warnings.warn(
        f"the plugin {name} ({where}) cannot be loaded and is left out: {reason}; install its "
        "package again, or remove it.",
        BayesdistWarning,
        stacklevel=1,
    )
