"""Values as plain JSON, and keys of artefacts: a hash of what each was made from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, is_dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel
from pydantic_core import to_jsonable_python


@dataclass(frozen=True)
class Adjustable:
    """Settings that may change while a stage is resumed: in its key, not in its checkpoints."""

    value: Any


def as_json(value: Any) -> Any:
    """A value as plain JSON: null for what is not a finite number; TypeError for unknown content.

    Settings, dataclasses, arrays, paths, and mappings and sequences of these become mappings,
    lists, text, numbers and None.  A set has no order, and is refused.
    """
    _refuse_sets(value)
    return to_jsonable_python(value, inf_nan_mode="null", fallback=_plain)


def attributes(one: Any, names: str) -> dict[str, Any]:
    """Attributes of an object as a row, by their names; None each where there is no object."""
    return {name: None if one is None else getattr(one, name) for name in names.split()}


def _refuse_sets(value: Any) -> None:
    """TypeError for a set anywhere in a value: pydantic would list it in the order of hashes."""
    if value is None or isinstance(value, str | int | float | np.ndarray):
        return  # at once: whether these are models or mappings takes long to find out
    if isinstance(value, set | frozenset):
        raise TypeError(f"{type(value).__name__} is no JSON and cannot be in a record or a key")
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, list | tuple):
        if (is_dataclass(value) and not isinstance(value, type)) or isinstance(value, BaseModel):
            value = vars(value)
        if not isinstance(value, Mapping):
            return
        value = value.values()
    for one in value:
        _refuse_sets(one)


def _plain(value: Any) -> Any:
    """What pydantic does not know, as lists, numbers and dictionaries."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{type(value).__name__} is no JSON and cannot be in a record or a key")


def digest_of(value: Any) -> str:
    """SHA-256 of a value as plain JSON: 64 hexadecimal digits."""
    return digest_of_plain(as_json(value))


def digest_of_plain(plain: Any) -> str:
    """SHA-256 of plain JSON, as by `as_json`."""
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def differences(known: Any, now: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Dotted path, old and new value of whatever differs between two values of plain JSON.

    Mappings are compared key by key, lists of equal length row by row where they hold mappings.
    """
    if isinstance(known, Mapping) and isinstance(now, Mapping):
        for key in dict.fromkeys([*known, *now]):
            at = f"{path}.{key}" if path else str(key)
            yield from differences(known.get(key), now.get(key), at)
    elif _rows(known) and _rows(now) and len(known) == len(now):
        for k, (one, other) in enumerate(zip(known, now, strict=True)):
            yield from differences(one, other, f"{path}[{k + 1}]" if path else "")
    elif known != now:
        yield path, known, now


def difference(known: Any, now: Any) -> str:
    """The first difference in words, '' where there is none."""
    for path, old, new in differences(known, now):
        if path.startswith("from."):
            return f"{path.removeprefix('from.')} has other results"
        return f"{path} {shown(old)} is now {shown(new)}"
    return ""


def _rows(value: Any) -> bool:
    """Boolean: a list of mappings."""
    return isinstance(value, list) and all(isinstance(one, Mapping) for one in value)


def shown(value: Any) -> str:
    """A value as text that is not too long for a line."""
    text = "none" if value is None else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."
