"""What is wrong with a configuration, in one sentence of the user's words instead of pydantic's."""

from __future__ import annotations

from difflib import get_close_matches
from typing import Any

from pydantic import BaseModel, ValidationError

from bayesdist.errors import ConfigError

__all__ = ["as_config_error"]

# what pydantic asks for, in the words of TOML
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


def as_config_error(kind: type[BaseModel], error: ValidationError, where: str) -> ConfigError:
    """The first thing that is wrong, with its key.

    Parameters
    ----------
    kind : type of pydantic.BaseModel
        What the file was validated against.
    error : pydantic.ValidationError
    where : str
        The file.
    """
    # an unknown key is usually the cause of a missing one
    details = sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    first = details[0]
    path = [str(p) for p in first["loc"] if not _is_branch(p)]
    key = _dotted(first["loc"])
    if first["type"] == "extra_forbidden":
        known = _known_keys(kind, first["loc"][:-1])
        near = get_close_matches(path[-1], known, 1, cutoff=0.4)
        do = f"use {near[0]!r} if that is meant" if near else f"known: {', '.join(sorted(known))}"
        return ConfigError(f"unknown key {path[-1]!r}", where=f"{where}: {key}", do=do)
    if first["type"] == "missing":
        return ConfigError("this value is missing", where=f"{where}: {key}", do="add it")
    if first["type"] == "value_error":
        cause, _, do = first["msg"].removeprefix("Value error, ").partition("; ")
        return ConfigError(cause, where=where, do=do)
    # of a value that may be of several kinds each kind says what it would take
    wanted = dict.fromkeys(_wanted(e) for e in details if _dotted(e["loc"]) == key)
    return ConfigError(
        f"{first['input']!r} does not fit",
        where=f"{where}: {key}",
        do="give " + " or ".join(wanted),
    )


def _wanted(detail: Any) -> str:
    """What would fit, in words."""
    if detail["type"] == "list_type" and isinstance(detail["input"], dict):
        return "its header double brackets, for there may be several"
    if detail["type"] in _KINDS:
        return _KINDS[detail["type"]]
    wanted = detail["msg"].removeprefix("Input should be ")
    if wanted.startswith(("greater", "less")):
        return f"a number {wanted}"
    return wanted[0].lower() + wanted[1:]


def _is_branch(part: str | int) -> bool:
    """Whether part of a location names a branch of a union, not a key."""
    return isinstance(part, str) and ("[" in part or part in _BRANCHES)


def _dotted(location: tuple[str | int, ...]) -> str:
    out = ""
    for part in location:
        if isinstance(part, int):
            out += f"[{part + 1}]"
        elif not _is_branch(part):
            out += f".{part}" if out else part
    return out


def _known_keys(kind: type[BaseModel], location: tuple[str | int, ...]) -> list[str]:
    """Keys of the section at a location."""
    current: Any = kind
    for part in location:
        if isinstance(part, int) or _is_branch(part):
            continue
        current = _section_of(current.model_fields[part].annotation)
    return list(current.model_fields)


def _section_of(annotation: Any) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in getattr(annotation, "__args__", ()):
        found = _section_of(inner)
        if found is not None:
            return found
    return None
