"""Records as arrays by name: frozen dataclasses of numbers, texts, arrays, and each other.

A record is written as a tree of its fields in JSON, in which an array stands by its name.  What is
read back is equal to the last bit.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from bayesdist.files.documents import json_of
from bayesdist.files.faults import restoring
from bayesdist.files.hdf5 import read_arrays, write_arrays

T = TypeVar("T")

TREE = "tree"
PACKAGE = "bayesdist."  # classes of others are not made from files


def write_record(path: Path, record: Any, fingerprint: str = "") -> None:
    """Write a record to an HDF5 file, with the fingerprint of what it belongs to."""
    write_arrays(path, fingerprint, record_to_arrays(record))


def read_record(path: Path, kind: type[T], what: str, *, do: str, fingerprint: str = "") -> T:
    """The record of a file.

    `kind`, and `what` in words, with its article: what it has to be; `do`: by which the file is
    made again. InputError for a file of another fingerprint, FormatError for one that holds no such
    record.
    """
    arrays = read_arrays(path, fingerprint, what, do=do)
    with restoring(path, what, do=do):
        found: T = record_from_arrays(arrays, kind)
        return found


def record_to_arrays(record: Any) -> dict[str, NDArray[Any]]:
    """Arrays by name that hold a record.

    Parameters
    ----------
    record : dataclass
        Its fields are None, numbers, texts, arrays, tuples, lists, mappings, other such records, or
        objects with ``to_dict`` and ``from_dict``.

    Returns
    -------
    dict of str to ndarray

    Raises
    ------
    TypeError
        For a field that is none of these.

    Examples
    --------
    >>> from bayesdist.utils.limits import PARETO_K
    >>> record_from_arrays(record_to_arrays(PARETO_K)) == PARETO_K
    True
    """
    writer = _Writer()
    tree = json.dumps(writer.of(record))
    return {TREE: np.frombuffer(tree.encode(), np.uint8), **writer.arrays}


def record_from_arrays(arrays: Mapping[str, NDArray[Any]], kind: type = object) -> Any:
    """The record that `record_to_arrays` described.

    `kind`: which it has to be. TypeError, KeyError, AttributeError for arrays that are no such
    record.
    """
    tree = json_of(np.asarray(arrays[TREE], np.uint8).tobytes().decode(), "record")
    found = _Reader(arrays).of(tree)
    if not isinstance(found, kind):
        raise TypeError(f"holds a {type(found).__name__}, and no {kind.__name__}")
    return found


@runtime_checkable
class _Described(Protocol):
    """An object that describes itself in JSON."""

    def to_dict(self) -> dict[str, Any]: ...

    @classmethod
    def from_dict(cls, state: dict[str, Any]) -> Self: ...


class _Writer:
    """The tree of a record, and its arrays; what stands twice in it is written once."""

    def __init__(self) -> None:
        self.arrays: dict[str, NDArray[Any]] = {}
        self._written: dict[
            int, tuple[Any, Any]
        ] = {}  # by id: the object, kept alive, and its tree

    def of(self, value: Any) -> Any:
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, np.ndarray):
            return self._once(value, self._array)
        if isinstance(value, tuple | list):
            return {type(value).__name__: [self.of(one) for one in value]}
        if isinstance(value, Mapping):
            return {"mapping": [[self.of(k), self.of(v)] for k, v in value.items()]}
        if isinstance(value, _Described):
            return self._once(value, self._plain)
        if is_dataclass(value) and not isinstance(value, type):
            return {"class": _name(value), "fields": self._fields(value)}
        raise TypeError(f"{type(value).__name__} cannot be written as arrays")

    def _fields(self, value: Any) -> dict[str, Any]:
        named = [one.name for one in fields(value) if one.init and not one.name.startswith("_")]
        return {name: self.of(getattr(value, name)) for name in named}

    def _once(self, value: Any, make: Any) -> Any:
        if id(value) not in self._written:
            self._written[id(value)] = (value, make(value))
        return self._written[id(value)][1]

    def _array(self, value: NDArray[Any]) -> Any:
        if value.dtype.kind in "US":
            return {"texts": value.tolist()}
        name = f"array{len(self.arrays)}"
        self.arrays[name] = value
        return {"array": name}

    @staticmethod
    def _plain(value: Any) -> Any:
        return {"class": _name(value), "dict": value.to_dict()}


class _Reader:
    """A record from its tree; equal objects of one class are one object."""

    def __init__(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        self._arrays = arrays
        self._made: dict[str, Any] = {}

    def of(self, tree: Any) -> Any:
        if not isinstance(tree, dict):
            return tree
        if "array" in tree:
            return np.asarray(self._arrays[tree["array"]])
        if "texts" in tree:
            return np.array(tree["texts"])
        if "tuple" in tree:
            return tuple(self.of(one) for one in tree["tuple"])
        if "list" in tree:
            return [self.of(one) for one in tree["list"]]
        if "mapping" in tree:
            return {self.of(key): self.of(value) for key, value in tree["mapping"]}
        if "dict" in tree:
            key = json.dumps(tree)
            if key not in self._made:
                self._made[key] = _class(tree["class"]).from_dict(tree["dict"])
            return self._made[key]
        return _class(tree["class"])(**{k: self.of(v) for k, v in tree["fields"].items()})


def _name(value: Any) -> str:
    return f"{type(value).__module__}:{type(value).__qualname__}"


def _class(name: str) -> Any:
    """A class that records are made of; TypeError for a name of anything else."""
    module, _, qualified = name.partition(":")
    found = getattr(import_module(module), qualified, None) if module.startswith(PACKAGE) else None
    held = isinstance(found, type) and (is_dataclass(found) or hasattr(found, "from_dict"))
    if not held or found.__module__ != module:
        raise TypeError(f"{name} is no class of this package's records")
    return found
