"""Errors of a configuration, as one sentence in the words of the user."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from bayesdist.app.config.section import Section
from bayesdist.errors import ConfigError

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
