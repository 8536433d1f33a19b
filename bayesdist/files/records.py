"""Serialisation of frozen dataclasses with numbers, texts, arrays and nested dataclasses.

A record is stored as arrays by name. One of them is the JSON tree of its fields, which refers to
the other arrays by name. Values are restored exactly, to the last bit.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
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
PACKAGE = "bayesdist"


def write_record(path: Path, record: Any, fingerprint: str = "") -> None:
    """Write a record to an HDF5 file, with the fingerprint of the data it belongs to."""
    write_arrays(path, fingerprint, record_to_arrays(record))


def read_record(
    path: Path,
    kind: type[T],
    what: str,
    *,
    do: str,
    fingerprint: str = "",
    packages: Collection[str] = (),
) -> T:
    """Read the record of a file.

    `kind`: class of the record. `what`: the record in words, with its article, for error messages.
    `do`: advice on how to make the file again. `packages`: see `record_from_arrays`. Raises
    InputError if the file has another fingerprint, FormatError if it contains no such record.
    """
    arrays = read_arrays(path, fingerprint, what, do=do)
    with restoring(path, what, do=do):
        record: T = record_from_arrays(arrays, kind, packages)
        return record


def record_to_arrays(record: Any) -> dict[str, NDArray[Any]]:
    """Convert a record to arrays by name.

    Parameters
    ----------
    record : dataclass
        Fields can be None, numbers, texts, arrays, tuples, lists, mappings, other such dataclasses,
        or objects with ``to_dict`` and ``from_dict``.

    Returns
    -------
    dict of str to ndarray

    Raises
    ------
    TypeError
        If a field has another type.

    Examples
    --------
    >>> from bayesdist.utils.checks import PARETO_K
    >>> record_from_arrays(record_to_arrays(PARETO_K)) == PARETO_K
    True
    """
    writer = _Writer()
    tree = json.dumps(writer.of(record))
    return {TREE: np.frombuffer(tree.encode(), np.uint8), **writer.arrays}


def record_from_arrays(
    arrays: Mapping[str, NDArray[Any]], kind: type = object, packages: Collection[str] = ()
) -> Any:
    """Restore a record from the arrays of `record_to_arrays`.

    `kind`: class of the record. `packages`: names of the packages whose classes the record may
    contain, in addition to those of bayesdist. Raises TypeError, KeyError or AttributeError if the
    arrays do not contain such a record.
    """
    tree = json_of(np.asarray(arrays[TREE], np.uint8).tobytes().decode(), "record")
    record = _Reader(arrays, {PACKAGE, *packages}).of(tree)
    if not isinstance(record, kind):
        raise TypeError(f"holds a {type(record).__name__}, not a {kind.__name__}")
    return record


@runtime_checkable
class _Described(Protocol):
    """An object that can be converted to and from a JSON tree."""

    def to_dict(self) -> dict[str, Any]: ...

    @classmethod
    def from_dict(cls, state: dict[str, Any]) -> Self: ...


class _Writer:
    """Builds the tree of a record and collects its arrays; repeated objects are stored once."""

    def __init__(self) -> None:
        self.arrays: dict[str, NDArray[Any]] = {}
        self._written: dict[
            int, tuple[Any, Any]
        ] = {}  # by id: the object, to keep it alive, and its tree

    def of(self, value: Any) -> Any:
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, np.ndarray):
            return self._once(value, self._array)
        if isinstance(value, tuple | list):
            return {type(value).__name__: [self.of(item) for item in value]}
        if isinstance(value, Mapping):
            return {"mapping": [[self.of(k), self.of(v)] for k, v in value.items()]}
        if isinstance(value, _Described):
            return self._once(value, self._plain)
        if is_dataclass(value) and not isinstance(value, type):
            return {"class": _name(value), "fields": self._fields(value)}
        raise TypeError(f"{type(value).__name__} cannot be written as arrays")

    def _fields(self, value: Any) -> dict[str, Any]:
        named = [
            entry.name for entry in fields(value) if entry.init and not entry.name.startswith("_")
        ]
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
    """Restores a record from its tree; equal trees of one class give the same object."""

    def __init__(self, arrays: Mapping[str, NDArray[Any]], packages: Collection[str]) -> None:
        self._arrays, self._packages = arrays, packages
        self._made: dict[str, Any] = {}

    def of(self, tree: Any) -> Any:
        if not isinstance(tree, dict):
            return tree
        if "array" in tree:
            return np.asarray(self._arrays[tree["array"]])
        if "texts" in tree:
            return np.array(tree["texts"])
        if "tuple" in tree:
            return tuple(self.of(item) for item in tree["tuple"])
        if "list" in tree:
            return [self.of(item) for item in tree["list"]]
        if "mapping" in tree:
            return {self.of(key): self.of(value) for key, value in tree["mapping"]}
        if "dict" in tree:
            key = json.dumps(tree)
            if key not in self._made:
                self._made[key] = _class(tree["class"], self._packages).from_dict(tree["dict"])
            return self._made[key]
        return _class(tree["class"], self._packages)(
            **{k: self.of(v) for k, v in tree["fields"].items()}
        )


def _name(value: Any) -> str:
    return f"{type(value).__module__}:{type(value).__qualname__}"


def _class(name: str, packages: Collection[str]) -> Any:
    """Class with a given name; raises TypeError if it is not a record class of these packages."""
    module, _, qualified = name.partition(":")
    known = module.partition(".")[0] in packages
    cls = getattr(import_module(module), qualified, None) if known else None
    held = isinstance(cls, type) and (is_dataclass(cls) or hasattr(cls, "from_dict"))
    if not held or cls.__module__ != module:
        raise TypeError(f"{name} is not a class of the records of {', '.join(sorted(packages))}")
    return cls
