"""Reading and validation of configurations of all kinds, and of other TOML files."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeAlias, Union

from pydantic import Discriminator, Field, Tag, TypeAdapter, ValidationError

from bayesdist.app.config.assess import RequirementBlock
from bayesdist.app.config.errors import as_config_error
from bayesdist.app.config.run import RunConfig
from bayesdist.app.config.section import Section
from bayesdist.assess import Requirement
from bayesdist.errors import ConfigError, InputError
from bayesdist.files.documents import toml_of
from bayesdist.files.regular import MOST_TEXT, read_text
from bayesdist.plugin import objects
from bayesdist.utils.text import refuse_control_characters

Config: TypeAlias = RunConfig


def installed_kinds() -> dict[str, type[RunConfig]]:
    """Configurations of this and of other packages, by the section that determines the kind.

    The plugins are asked at each call, not when this module is imported: their modules import it.
    """
    return objects(lambda plugin: plugin.kinds, flaw=_flaw)


def _flaw(kind: object) -> str:
    """Why an object cannot be the configuration of a kind; empty if it can."""
    if not (isinstance(kind, type) and issubclass(kind, RunConfig)):
        return "it is not a subclass of bayesdist.app.config.StarsConfig"
    missing = [name for name in ("title", "kind") if not hasattr(kind, name)]
    return f"it has no attribute {missing[0]!r}" if missing else ""


def _kinds_given(raw: Any, kinds: Iterable[str]) -> list[str]:
    """Sections of a configuration that determine its kind."""
    return [kind for kind in kinds if isinstance(raw, dict) and raw.get(kind) is not None]


def _beginnings(kinds: Mapping[str, type[RunConfig]]) -> str:
    """Clause that lists the sections a run may begin with."""
    clauses = [f"with [{section}], {kind.title}" for section, kind in kinds.items()]
    *first, last = clauses
    return f"a run begins {', '.join(first)}, or {last}" if first else f"a run begins {last}"


@cache
def _adapter(kinds: tuple[tuple[str, type[RunConfig]], ...]) -> TypeAdapter[Config]:
    """Validator of the configurations of these kinds."""
    sections = [section for section, _ in kinds]

    def kind_of(raw: Any) -> str | None:
        given = _kinds_given(raw, sections)
        return given[0] if len(given) == 1 else None

    union: Any = Union[*(Annotated[kind, Tag(section)] for section, kind in kinds)]
    message = f"{_beginnings(dict(kinds))}; give one"
    return TypeAdapter(
        Annotated[
            union,
            Discriminator(kind_of, custom_error_type="no_kind", custom_error_message=message),
        ]
    )


def _refuse_other_kinds(
    kinds: Mapping[str, type[RunConfig]], raw: Mapping[str, Any], where: str
) -> None:
    """Refuse a configuration that begins with a section of no installed kind."""
    if not kinds:
        raise ConfigError(
            "no kind of run is installed",
            where=where,
            do="leave the environment variable BAYESDIST_PLUGINS unset, or add 'kinds' to it",
        )
    if _kinds_given(raw, kinds):
        return
    known = {section for kind in kinds.values() for section in kind.model_fields}
    if unknown := [f"[{section}]" for section in raw if section not in known]:
        raise ConfigError(
            f"no installed kind of run has {' or '.join(unknown)}: {_beginnings(kinds)}",
            where=where,
            do="begin with one of these, or install the plugin of the kind (BAYESDIST_PLUGINS may "
            "exclude it)",
        )


# limits on numbers: beyond plausible values in any unit, but far from overflow
LEAST, MOST, MOST_WHOLE = 1e-20, 1e15, 2**63 - 1


@contextmanager
def _as_config_errors(where: str = "") -> Iterator[None]:
    """Convert InputError to ConfigError, with the name of the file if given."""
    try:
        yield
    except InputError as error:
        place = f"{where}: {error.where}" if where else error.where
        raise ConfigError(error.cause, where=place, do=error.do) from error


class _RequirementFile(Section):
    requirement: Annotated[list[RequirementBlock], Field(min_length=1)]


def load_config(path: str | Path) -> tuple[Config, str]:
    """Read a configuration file.

    Parameters
    ----------
    path : path

    Returns
    -------
    config : RunConfig
        Of the class of its kind of run.
    text : str
        Unchanged text of the file.

    Raises
    ------
    ConfigError
        If the file cannot be read or the configuration is invalid.
    """
    text = load_text(path)
    return parse_config(text, str(path)), text


def parse_config(text: str, where: str) -> Config:
    """Validate a configuration.

    Parameters
    ----------
    text : str
        Configuration in TOML.
    where : str
        Name of the configuration in errors.

    Returns
    -------
    RunConfig
        Of the class of its kind of run.

    Raises
    ------
    ConfigError
        If the configuration is invalid.
    """
    raw = _settings(text, where, begin="write one by 'bayesdist init'")
    kinds = installed_kinds()
    _refuse_other_kinds(kinds, raw, where)
    config: Config = _validated(_adapter(tuple(kinds.items())), kinds, raw, where)
    with _as_config_errors(where):
        config.time()
        # matches may state their radius, which is unknown until they are read
        config.mixture(1.0 if config.begins_with == "fit" else None)
        config.user_terms()
        config.requirements()
        config.spans()
    return config


def config_of_record(settings: Mapping[str, Any], where: str) -> Config:
    """Configuration from the record of a run.

    Parameters
    ----------
    settings : mapping
        Configuration as stored in run.json.
    where : str
        Name of the record in errors.

    Returns
    -------
    RunConfig
        Of the class of its kind of run.

    Raises
    ------
    ConfigError
        If the settings are invalid, for example if they are from another version.
    """
    kinds = installed_kinds()
    _refuse_other_kinds(kinds, settings, where)
    try:
        return _adapter(tuple(kinds.items())).validate_python(settings)
    except ValidationError as error:
        raise as_config_error(kinds, error, where) from error


def load_requirements(path: str | Path) -> tuple[Requirement, ...]:
    """Read the ``[[requirement]]`` blocks of a file.

    Parameters
    ----------
    path : path
        TOML file, which may be a complete configuration.

    Returns
    -------
    tuple of Requirement

    Raises
    ------
    ConfigError
        If the file cannot be read, has no such blocks, or a block is invalid.
    """
    text, begin = load_text(path), "give it [[requirement]] blocks"
    settings = _settings(text, str(path), begin=begin)
    if "requirement" in settings and settings.keys() & {"data", "detector", "model"}:
        settings = {"requirement": settings["requirement"]}
    kind = _RequirementFile
    blocks = _validated(TypeAdapter(kind), kind, settings, str(path)).requirement
    with _as_config_errors(str(path)):
        return tuple(Requirement(**r.model_dump()) for r in blocks)


def load_text(path: str | Path) -> str:
    """Text of a configuration file, unchanged including its line endings.

    Raises ConfigError if the file cannot be read.
    """
    with _as_config_errors():
        return read_text(path, most=MOST_TEXT)


def validated(kind: type[Section], text: str, where: str, *, begin: str) -> Any:
    """Validate the text of a TOML file as a section class.

    `where` is the name of the file in errors, `begin` the advice if it holds no settings.
    """
    return _validated(TypeAdapter(kind), kind, _settings(text, where, begin=begin), where)


def _settings(text: str, where: str, *, begin: str) -> dict[str, Any]:
    """Settings of a TOML text; raises ConfigError if it is empty."""
    with _as_config_errors():
        raw = toml_of(text.removeprefix("\ufeff"), where)
    if not raw:
        raise ConfigError("holds no settings", where=where, do=begin)
    for key, value in _leaves(raw, ""):
        if isinstance(value, str):
            with _as_config_errors():
                refuse_control_characters([value], f"{where}: {key}")
            continue
        large = MOST_WHOLE if isinstance(value, int) else MOST
        if abs(value) > large or 0 < abs(value) < LEAST:
            number = str(value) if len(str(value)) < 30 else f"{str(value)[:20]}..."
            raise ConfigError(
                f"{number} is not a plausible number",
                where=f"{where}: {key}",
                do=f"give one between {LEAST:g} and {large:g}",
            )
    return raw


def _leaves(tree: Any, key: str) -> Iterator[tuple[str, int | float | str]]:
    """Keys and values of all texts and finite numbers of a tree."""
    if isinstance(tree, dict):
        for name, inner in tree.items():
            yield from _leaves(inner, f"{key}.{name}" if key else name)
    elif isinstance(tree, list):
        for k, inner in enumerate(tree, 1):
            yield from _leaves(inner, f"{key}[{k}]")
    elif isinstance(tree, int | str) or (isinstance(tree, float) and math.isfinite(tree)):
        yield key, tree


def _validated(
    adapter: TypeAdapter[Any],
    kinds: type[Section] | Mapping[str, type[Section]],
    raw: Mapping[str, Any],
    where: str,
) -> Any:
    """Validate settings; `kinds` are the models, for errors."""
    try:
        # validated as JSON, in which arrays may become tuples but text does not become a number
        with _as_config_errors(where):
            return adapter.validate_json(json.dumps(raw, default=str), strict=True)
    except ValidationError as error:
        raise as_config_error(kinds, error, where) from error
