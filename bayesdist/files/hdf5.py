"""HDF5 and netCDF files: arrays, and dataclasses as records of arrays.

Arrays that are read are plausible for the size of the file. A record is a frozen dataclass with
numbers, texts, arrays and nested dataclasses. It is stored as arrays by name. One of them is the
JSON tree of its fields, which refers to the other arrays by name. Values are restored exactly, to
the last bit.
"""

from __future__ import annotations

import io
import json
import math
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import FormatError, InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.files.budget import DAMAGED, LIMITS, Budget, FileLimits
from bayesdist.files.documents import json_of
from bayesdist.files.faults import deferred_interrupts, restoring
from bayesdist.utils.memory import size_text

if TYPE_CHECKING:
    import h5py


def hdf5_arrays(
    path: Path, names: Sequence[str] | None = None, limits: FileLimits = LIMITS
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays of an HDF5 file by name, and its attributes.

    `names`: names of the arrays to read; by default all at the top level of the file. Raises
    InputError if the path is not a regular file, FormatError if arrays exceed the limits of the
    file, and, like h5py, OSError or KeyError if the file is damaged.
    """
    with _checked(path, limits) as file:
        arrays = {name: file[name][...] for name in names or file}
        return arrays, dict(file.attrs)


@dataclass(frozen=True)
class NetcdfGroup:
    """Variables of a group of a netCDF file, in memory, and its attributes."""

    arrays: dict[str, NDArray[Any]]
    attrs: dict[str, Any]


def netcdf_groups(path: Path, limits: FileLimits = LIMITS) -> dict[str, NetcdfGroup]:
    """Groups of a netCDF file by name, with '' for the top level; errors as in `hdf5_arrays`.

    xarray.DataTree would take five times as long, and half a second to import.
    """
    import h5py

    with _checked(path, limits) as file:
        groups = {name: member for name, member in file.items() if isinstance(member, h5py.Group)}
        return {name: _group(group) for name, group in {"": file, **groups}.items()}


def _group(group: h5py.Group) -> NetcdfGroup:
    """Content of a group; netCDF stores scalar attributes as arrays of length one."""
    import h5py

    arrays = {
        name: (dataset.asstr() if h5py.check_string_dtype(dataset.dtype) else dataset)[...]
        for name, dataset in group.items()
        if isinstance(dataset, h5py.Dataset) and not _is_bare_dimension(dataset)
    }
    attrs = {
        name: value[0] if isinstance(value, np.ndarray) and value.shape == (1,) else value
        for name, value in group.attrs.items()
    }
    return NetcdfGroup(arrays, attrs)


def _is_bare_dimension(dataset: h5py.Dataset) -> bool:
    """True for a dimension without values, for which netCDF stores an array of zeros."""
    title = dataset.attrs.get("NAME", b"")
    return isinstance(title, bytes) and title.startswith(b"This is a netCDF dimension but not")


@contextmanager
def _checked(path: Path, limits: FileLimits = LIMITS) -> Iterator[h5py.File]:
    """Context manager for an open file with arrays that are safe to read."""
    import h5py

    budget = Budget.of_file(path, limits)
    with h5py.File(path, "r") as file:
        budget.refuse_content(_Announced(budget).bytes_of(file))
        yield file


_DEFLATE, _DEFLATE_RATIO = 1, 1032  # filter code of gzip in HDF5, and largest compression of zlib
_COMPRESSORS = {_DEFLATE, 4, 32000}  # szip and lzf compress by a factor of at most a hundred
_FLETCHER32, _CHECKSUM = 3, 4  # filter code, and bytes that it adds to a chunk
# shuffle, fletcher32, nbit and scale-offset, whose results have predictable sizes
_FILTERS = {2, _FLETCHER32, 5, 6}


class _Announced:
    """Size of arrays as announced by a file; an array counts once per path that leads to it.

    Links can make the number of paths to a group very large, so each group is visited once.
    """

    def __init__(self, budget: Budget) -> None:
        self._budget = budget
        self._clock = budget.clock()
        self._totals: dict[int, int] = {}  # bytes by address of a visited group
        self._links = 0
        self._attributes = 0  # bytes of those of variable length

    def bytes_of(self, group: h5py.Group, depth: int = 1) -> int:
        """Size in bytes of the arrays in a group and its subgroups."""
        import h5py

        address = h5py.h5o.get_info(group.id).addr
        if address not in self._totals:
            self._budget.refuse_depth(depth, "groups")
            self._refuse_attributes(group)
            self._totals[address] = 0  # ends the recursion if a group contains itself
            self._totals[address] = sum(self._member(group, name, depth) for name in group)
        return self._totals[address]

    def _member(self, group: h5py.Group, name: str, depth: int) -> int:
        import h5py

        self._links += 1
        self._budget.refuse_nodes(self._links, "groups and arrays")
        self._clock()
        link = group.get(name, getlink=True)
        member = group.get(name) if isinstance(link, h5py.HardLink) else None
        if isinstance(member, h5py.Group):
            return self.bytes_of(member, depth + 1)
        if isinstance(member, h5py.Dataset) and not member.external and not member.is_virtual:
            self._refuse_inflated(member)
            self._refuse_attributes(member)
            self._refuse_texts(member)
            # a chunk is read completely, even if the array is smaller
            n = max(int(member.size or 0), math.prod(member.chunks or (0,)))
            return n * member.dtype.itemsize
        if not isinstance(member, h5py.Datatype):
            soft = isinstance(link, h5py.SoftLink)
            raise FormatError(
                f"{name!r} {'is a soft link' if soft else 'lies in another file'}",
                where=self._budget.where,
                do="restore it, or make it again",
            )
        return 0

    def _refuse_texts(self, array: h5py.Dataset) -> None:
        """Refuse texts, and other values of variable length, that are together too long.

        Any number of them may lie at one place of the file.  None is longer than the file, so that
        as many as the budget has room for are read at a time.
        """
        if not array.dtype.hasobject or not array.size:
            return
        self._budget.refuse_content(8 * array.size)
        total = 0
        step = max(1, self._budget.content // max(self._budget.size, 1))
        for leading in np.ndindex(array.shape[:-1]):
            for begin in range(0, (array.shape or (1,))[-1], step):
                self._clock()
                at = (*leading, slice(begin, begin + step)) if array.shape else ()
                total += _length(array[at])
                self._budget.refuse_content(total)

    def _refuse_attributes(self, owner: h5py.Group | h5py.Dataset) -> None:
        """Refuse attributes as of `_refuse_texts`; each is read whole."""
        import h5py

        for name in owner.attrs:
            self._clock()
            attribute = h5py.h5a.open(owner.id, name.encode())
            n = math.prod(attribute.shape)
            if attribute.dtype.hasobject and not _lists_references(attribute.dtype, n):
                self._budget.refuse_content(n * self._budget.size)
                self._attributes += _length(owner.attrs[name])
                self._budget.refuse_content(self._attributes)

    def _refuse_inflated(self, array: h5py.Dataset) -> None:
        """Refuse gzip chunks that decompress to more than a chunk: HDF5 would read all of it."""
        pipeline = array.id.get_create_plist()
        filters = [pipeline.get_filter(k)[0] for k in range(pipeline.get_nfilters())]
        compressors = [code for code in filters if code not in _FILTERS]
        if len(compressors) > 1 or not set(compressors) <= _COMPRESSORS:
            raise FormatError(
                "has an array with an unsupported compression",
                where=self._budget.where,
                do="write it with gzip, lzf, szip or none",
            )
        if _DEFLATE not in compressors:
            return
        large = list[tuple[int, ...]]()

        def note(chunk: Any) -> None:
            if _DEFLATE_RATIO * chunk.size > self._budget.content:
                large.append(chunk.chunk_offset)

        array.id.chunk_iter(note)
        room = math.prod(array.chunks) * array.dtype.itemsize
        room += _CHECKSUM * filters.count(_FLETCHER32)  # may be among what is compressed
        for offset in large:
            self._clock()
            _, raw = array.id.read_direct_chunk(offset)
            if len(zlib.decompressobj().decompress(raw, room + 1)) > room:
                raise FormatError(
                    f"has a chunk of {size_text(room)} that holds more",
                    where=self._budget.where,
                    do=DAMAGED,
                )


def _lists_references(dtype: np.dtype, n: int) -> bool:
    """True for n references to other arrays, as netCDF lists the arrays of a dimension.

    A dimension of n arrays has n of them, in records, and an array one list for each of its
    dimensions, of which HDF5 has up to 32.
    """
    import h5py

    parts = [dtype[name] for name in dtype.names] if dtype.names else [dtype]
    if all(not part.hasobject or h5py.check_ref_dtype(part) for part in parts):
        return True
    listed = h5py.check_vlen_dtype(dtype)
    return n <= 32 and listed is not None and h5py.check_ref_dtype(listed) is not None


def _length(value: Any) -> int:
    """Bytes of texts and arrays, also of those in an array or a record."""
    if isinstance(value, np.void):
        return sum(_length(member) for member in value.item())
    if isinstance(value, np.ndarray):
        inner = value.ravel() if value.dtype.hasobject else ()
        return int(value.nbytes) + sum(_length(member) for member in inner)
    return len(value) if isinstance(value, str | bytes) else 8


# -- arrays of bayesdist's own files, each with the fingerprint of the data they belong to ---------
def read_arrays(
    path: Path, fingerprint: str, what: str, names: Sequence[str] | None = None, *, do: str
) -> dict[str, NDArray[Any]]:
    """Read arrays from a file of `write_arrays`.

    `fingerprint`: fingerprint of data and settings. `what`: expected content, with its article.
    `names`: required arrays; by default all in the file. `do`: advice if the file cannot be read.
    Raises FormatError if the file is damaged, InputError if it does not exist, or belongs to other
    data or settings.
    """
    try:
        with restoring(path, what, do=do):
            arrays, marks = hdf5_arrays(path, names)
            stored_fingerprint = marks["fingerprint"]
    except InputError as error:  # about the path; add the advice for this file
        raise type(error)(error.cause, where=error.where, do=do) from error
    if not isinstance(stored_fingerprint, str) or stored_fingerprint != fingerprint:
        raise InputError(
            f"this is {what} of other data or settings",
            where=str(path),
            do="restore it, or start again with --force",
        )
    return arrays


class _PatientFile(io.FileIO):
    """File object for HDF5 that raises an error of the system only after HDF5 has closed its file.

    If an error is raised earlier, HDF5 fails again while closing and may terminate the process.
    """

    _refused: OSError | None = None

    def write(self, content: Any) -> int:
        remaining = memoryview(content)
        while remaining and self._refused is None:
            try:
                remaining = remaining[super().write(remaining) :]
            except OSError as error:
                self._refused = error
        return len(content)

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self._refused = self._refused or error
            return size or 0

    def close(self) -> None:
        super().close()
        if self._refused is not None:
            raise self._refused


def write_arrays(path: Path, fingerprint: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays to an HDF5 file atomically, with a `fingerprint` that `read_arrays` checks.

    Raises InputError if the system refuses to write.
    """
    import h5py

    with (
        deferred_interrupts(),
        atomic_path(path) as temporary,
        _PatientFile(temporary, "w+") as stream,
        h5py.File(stream, "w") as file,
    ):
        for name, values in arrays.items():
            file[name] = values
        file.attrs["fingerprint"] = fingerprint


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
