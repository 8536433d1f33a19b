"""Conversion of values to plain JSON, and keys of artefacts: hashes of their ingredients."""

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
    """Settings that may change when a stage is resumed.

    They are part of the key of the stage, but not of that of its checkpoints.

    Parameters
    ----------
    value : object
        Settings that `as_json` can convert.
    """

    value: Any


def as_json(value: Any) -> Any:
    """Convert a value to plain JSON.

    Parameters
    ----------
    value : object
        Settings, dataclasses, arrays, paths, or mappings and sequences of these.

    Returns
    -------
    object
        Mappings, lists, text, numbers and None.  Numbers that are not finite become None.

    Raises
    ------
    TypeError
        If the value contains anything else, or a set, which has no order.
    """
    _refuse_sets(value)
    return to_jsonable_python(value, inf_nan_mode="null", fallback=_plain)


def attributes(one: Any, names: str) -> dict[str, Any]:
    """Attributes of an object by name, as a row; all None if the object is None."""
    return {name: None if one is None else getattr(one, name) for name in names.split()}


def _refuse_sets(value: Any) -> None:
    """Raise TypeError for a set anywhere in a value: pydantic would list it in hash order."""
    if value is None or isinstance(value, str | int | float | np.ndarray):
        return  # first, because tests for models and mappings are slow
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
    for element in value:
        _refuse_sets(element)


def _plain(value: Any) -> Any:
    """Convert values that pydantic cannot serialise to lists, numbers and dictionaries."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{type(value).__name__} is no JSON and cannot be in a record or a key")


def digest_of(value: Any) -> str:
    """SHA-256 of a value as plain JSON: 64 hexadecimal digits."""
    return digest_of_plain(as_json(value))


def digest_of_plain(plain: Any) -> str:
    """SHA-256 of a value that is already plain JSON, as returned by `as_json`."""
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def differences(known: Any, now: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Compare two values of plain JSON.

    Mappings are compared key by key, and lists of mappings of equal length row by row.

    Parameters
    ----------
    known, now : object
        Old and new value.
    path : str
        Dotted path that the values are found at.

    Yields
    ------
    tuple of str, object, object
        Dotted path, old value and new value of each difference.
    """
    if isinstance(known, Mapping) and isinstance(now, Mapping):
        for key in dict.fromkeys([*known, *now]):
            at = f"{path}.{key}" if path else str(key)
            yield from differences(known.get(key), now.get(key), at)
    elif _rows(known) and _rows(now) and len(known) == len(now):
        for k, (old_row, new_row) in enumerate(zip(known, now, strict=True)):
            yield from differences(old_row, new_row, f"{path}[{k + 1}]" if path else "")
    elif known != now:
        yield path, known, now


def difference(known: Any, now: Any) -> str:
    """Sentence on the first difference between two values; empty if they are equal."""
    for path, old, new in differences(known, now):
        if path.startswith("from."):
            return f"{path.removeprefix('from.')} has other results"
        return f"{path} {shown(old)} is now {shown(new)}"
    return ""


def _rows(value: Any) -> bool:
    """True for a list of mappings."""
    return isinstance(value, list) and all(isinstance(row, Mapping) for row in value)


def shown(value: Any) -> str:
    """Text of a value, shortened to fit on a line."""
    text = "none" if value is None else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."
