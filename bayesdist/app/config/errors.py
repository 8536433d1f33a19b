"""One sentence on what is wrong with a configuration, in the user's words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from bayesdist.errors import ConfigError

Location = tuple[str | int, ...]

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


# new names of old keys, by section
RENAMED = {
    "assess.horizon": "years_ahead",
    "budget.in_residuals": "included_in_scatter",
    "campaign.aberration": "vafactor_source",
    "campaign.motions": "pm_selection",
    "campaign.start": "initial_distortion",
    "selfcal.least_detections": "min_detections",
    "selfcal.rounds": "max_iterations",
    "selfcal.start": "initial_distortion",
    "tables.rounds": "max_iterations",
}

# what to set in place of a key that a kind of run does not have
INSTEAD = {
    ("selfcal", "model.frames"): "set selfcal.frames",
    ("selfcal", "outliers.match_radius"): "set selfcal.match_radius",
    ("selfcal", "products.wise_meta"): "ask for sip or idctab",
    ("campaign", "model.frames"): "leave it out: a campaign has frames of its own",
    ("selfcal", "prior_calibration"): "set selfcal.initial_distortion, which is where it begins",
    ("campaign", "prior_calibration"): "leave it out: the scatter of the exposures is their prior",
    ("campaign", "prior"): "leave it out: the scatter of the exposures is their prior",
}

Kind = type[BaseModel]


def as_config_error(
    kinds: Kind | Mapping[str, Kind], error: ValidationError, where: str
) -> ConfigError:
    """The first thing that is wrong, with its key.

    `kinds`: what the file was validated against, or that by the section that says which one.
    """
    # an unknown key is usually the cause of a missing one
    details = sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    first = details[0]
    if isinstance(kinds, Mapping):
        for one in details:
            one["loc"], tag = one["loc"][1:], next(iter(one["loc"]), "")
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
    # of a value that may be of several types each type says what it would take
    wanted = dict.fromkeys(_wanted(e) for e in details if _dotted(e["loc"]) == key)
    return ConfigError(
        f"{first['input']!r} does not fit",
        where=f"{where}: {key}",
        do="give " + " or ".join(wanted),
    )


def _unknown_key(kinds: Mapping[str, Kind], kind: str, location: Location) -> tuple[str, str]:
    """Cause and advice for a key that a kind does not know."""
    parts = [part for part in location if isinstance(part, str) and not _is_branch(part)]
    name, path = parts[-1], ".".join(parts)
    if path in RENAMED:
        return f"unknown key {name!r}: it is called {RENAMED[path]!r} now", "rename it"
    others = [f"[{k}]" for k in kinds if k != kind and name in _known_keys(kinds[k], parts[:-1])]
    if others:
        cause = f"unknown key {name!r}: it is of {' and '.join(others)}, and this is a [{kind}]"
        return cause, INSTEAD.get((kind, path), "leave it out")
    known = _known_keys(kinds[kind], parts[:-1])
    near = get_close_matches(name, known, 1, cutoff=0.4)
    do = f"use {near[0]!r} if that is meant" if near else f"known: {', '.join(sorted(known))}"
    return f"unknown key {name!r}", do


def _wanted(detail: Any) -> str:
    """Values that would fit, in words."""
    if detail["type"] == "list_type" and isinstance(detail["input"], dict):
        return "its header double brackets, for there may be several"
    if detail["type"] in _KINDS:
        return _KINDS[detail["type"]]
    wanted = detail["msg"].removeprefix("Input should be ")
    if wanted.startswith(("greater", "less")):
        return f"a number {wanted}"
    return wanted[0].lower() + wanted[1:]


def _is_branch(part: str | int) -> bool:
    """Boolean: part of a location names a branch of a union, not a key."""
    return isinstance(part, str) and ("[" in part or part in _BRANCHES)


def _dotted(location: Location) -> str:
    """A location as the user writes it, its blocks counted from 1."""
    out = ""
    for part in location:
        if isinstance(part, int):
            out += f"[{part + 1}]"
        elif not _is_branch(part):
            out += f".{part}" if out else part
    return out


def _known_keys(kind: Kind, sections: Sequence[str]) -> list[str]:
    """Keys of a section, given by the names that lead to it; none where it is not known."""
    current: Any = kind
    for name in sections:
        field = _fields(current).get(name)
        current = None if field is None else _section_of(field.annotation)
        if current is None:
            return []
    return list(_fields(current))


def _fields(kind: Kind) -> dict[str, FieldInfo]:
    """Fields of a section, and those of the sections that formats of missions derive from it."""
    return {
        name: field
        for one in (kind, *kind.__subclasses__())
        for name, field in one.model_fields.items()
    }


def _section_of(annotation: Any) -> Any:
    """The model within an annotation; None where there is none."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in getattr(annotation, "__args__", ()):
        found = _section_of(inner)
        if found is not None:
            return found
    return None
