"""Reading and validation of configurations of all kinds, and of other TOML files.

Errors of a configuration are one sentence in the words of the user.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeAlias, Union

from pydantic import BaseModel, Discriminator, Field, Tag, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from bayesdist.app.config.results import RequirementBlock
from bayesdist.app.config.run import RunConfig
from bayesdist.app.config.section import Section
from bayesdist.assess import Requirement
from bayesdist.errors import ConfigError, InputError
from bayesdist.files.documents import toml_of
from bayesdist.files.regular import MOST_TEXT, read_text
from bayesdist.plugin import objects
from bayesdist.utils.text import refuse_control_characters

Config: TypeAlias = RunConfig

Location = tuple[str | int, ...]

# types in pydantic errors, described in terms of TOML
_KINDS = {
    "int_type": "a whole number",
    "float_type": "a number",
    "finite_number": "a finite number",
    "string_type": "text in quotes",
    "bool_type": "true or false",
    "model_type": "a table",
    "dict_type": "a table",
    "list_type": "a list",
    "tuple_type": "a list",
}

_BRANCHES = ("float", "str", "int", "constrained-float", "constrained-int", "constrained-str")

Kind = type[Section]


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


def as_config_error(
    kinds: Kind | Mapping[str, Kind], error: ValidationError, where: str
) -> ConfigError:
    """ConfigError for the first fault of a configuration, with its key.

    `kinds` is the model that the file was validated against, or a mapping of the possible models by
    the section that distinguishes them.
    """
    # an unknown key is usually the cause of a missing one
    details = sorted(_of_innermost(error.errors()), key=lambda e: e["type"] != "extra_forbidden")
    first = details[0]
    if isinstance(kinds, Mapping):
        for detail in details:
            detail["loc"], tag = detail["loc"][1:], next(iter(detail["loc"]), "")
    else:
        kinds, tag = {"": kinds}, ""
    key = _dotted(first["loc"])
    if first["type"] == "extra_forbidden":
        cause, do = _unknown_key(kinds, str(tag), first["loc"])
        return ConfigError(cause, where=f"{where}: {key}", do=do)
    if first["type"] == "missing":
        return ConfigError("this value is missing", where=f"{where}: {key}", do="add it")
    if first["type"] in ("value_error", "no_kind"):
        cause, _, do = first["msg"].removeprefix("Value error, ").partition("; ")
        return ConfigError(cause, where=where, do=do)
    # there is one detail for each type that the value may have; if the value is of one of these
    # types but for a part, that part is the cause
    parts = [e for e in details if _dotted(e["loc"]).startswith((f"{key}[", f"{key}."))]
    if parts:
        first, key = parts[0], _dotted(parts[0]["loc"])
    wanted = dict.fromkeys(_wanted(e) for e in details if _dotted(e["loc"]) == key)
    return ConfigError(
        f"{first['input']!r} does not fit",
        where=f"{where}: {key}",
        do="give " + " or ".join(wanted),
    )


def _of_innermost(details: Sequence[Any]) -> list[Any]:
    """Errors without those of a value for which there are also errors of its elements.

    Only the types of a union that the value as a whole does not fit give such errors.
    """
    paths = [tuple(part for part in d["loc"] if not _is_branch(part)) for d in details]
    outer = {path[:n] for path in paths for n in range(len(path))}
    return [d for d, path in zip(details, paths, strict=True) if path not in outer]


def _unknown_key(kinds: Mapping[str, Kind], kind: str, location: Location) -> tuple[str, str]:
    """Cause and advice for a key that a kind of configuration does not have."""
    parts = [part for part in location if isinstance(part, str) and not _is_branch(part)]
    name, path = parts[-1], ".".join(parts)
    for model in (kinds[kind], *kinds.values()):
        if path in model.renamed:
            return f"unknown key {name!r}: it is called {model.renamed[path]!r} now", "rename it"
    other_kinds = [
        f"[{k}]" for k in kinds if k != kind and name in _known_keys(kinds[k], parts[:-1])
    ]
    if other_kinds:
        cause = (
            f"unknown key {name!r}: it is of {' and '.join(other_kinds)}, and this is a [{kind}]"
        )
        return cause, kinds[kind].instead.get(path, "leave it out")
    keys = _known_keys(kinds[kind], parts[:-1])
    near = get_close_matches(name, keys, 1, cutoff=0.4)
    do = f"use {near[0]!r} if that is meant" if near else f"known: {', '.join(sorted(keys))}"
    return f"unknown key {name!r}", do


def _wanted(detail: Any) -> str:
    """Description of the values that would be valid."""
    if detail["type"] == "list_type" and isinstance(detail["input"], dict):
        return "its header double brackets, for there may be several"
    if detail["type"] in _KINDS:
        return _KINDS[detail["type"]]
    for kind, limit, words in (
        ("too_long", "max_length", "most"),
        ("too_short", "min_length", "least"),
    ):
        if detail["type"] == kind:
            n = detail["ctx"][limit]
            return f"at {words} {n} value{'s' if n != 1 else ''}"
    wanted = detail["msg"].removeprefix("Input should be ")
    if wanted.startswith(("greater", "less")):
        return f"a number {wanted}"
    return wanted[0].lower() + wanted[1:]


def _is_branch(part: str | int) -> bool:
    """True if part of a location names a branch of a union rather than a key."""
    return isinstance(part, str) and ("[" in part or part in _BRANCHES)


def _dotted(location: Location) -> str:
    """Location as the user writes it; blocks are counted from 1."""
    out = ""
    for part in location:
        if isinstance(part, int):
            out += f"[{part + 1}]"
        elif not _is_branch(part):
            out += f".{part}" if out else part
    return out


def _known_keys(kind: Kind, sections: Sequence[str]) -> list[str]:
    """Keys of the section at the end of a path of names; empty if it is unknown."""
    current: Any = kind
    for name in sections:
        field = _fields(current).get(name)
        current = None if field is None else _section_of(field.annotation)
        if current is None:
            return []
    return list(_fields(current))


def _fields(kind: type[BaseModel]) -> dict[str, FieldInfo]:
    """Fields of a section, including those of its subclasses for mission formats."""
    return {
        name: field
        for section in (kind, *kind.__subclasses__())
        for name, field in section.model_fields.items()
    }


def _section_of(annotation: Any) -> Any:
    """Model within an annotation; None if there is none."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in getattr(annotation, "__args__", ()):
        section = _section_of(inner)
        if section is not None:
            return section
    return None
