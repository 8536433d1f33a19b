"""HDF5 and netCDF files, whose arrays are no larger than their file allows."""

from __future__ import annotations

import io
import math
import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import FormatError, InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.files.budget import DAMAGED, LIMITS, Budget, Limits
from bayesdist.files.faults import restoring
from bayesdist.files.regular import opened
from bayesdist.utils.memory import size_text

if TYPE_CHECKING:
    import h5py


def hdf5_arrays(
    path: Path, names: Sequence[str] | None = None, limits: Limits = LIMITS
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays by name, and attributes, of an HDF5 file.

    `names`: arrays that are wanted; by default all at the top of the file. InputError for a path
    that is no regular file. FormatError for arrays that the file cannot hold. OSError, KeyError as
    h5py raises them for a damaged file.
    """
    with _checked(path, limits) as file:
        arrays = {name: file[name][...] for name in names or file}
        return arrays, dict(file.attrs)


@dataclass(frozen=True)
class NetcdfGroup:
    """Variables of a group of a netCDF file, in memory, and its attributes."""

    arrays: dict[str, NDArray[Any]]
    attrs: dict[str, Any]


def netcdf_groups(path: Path, limits: Limits = LIMITS) -> dict[str, NetcdfGroup]:
    """Groups of a netCDF file by their names, '' at its top; errors as of `hdf5_arrays`.

    A tree of xarray takes five times as long, and half a second to import.
    """
    import h5py

    with _checked(path, limits) as file:
        groups = {name: one for name, one in file.items() if isinstance(one, h5py.Group)}
        return {name: _group(group) for name, group in {"": file, **groups}.items()}


def _group(group: h5py.Group) -> NetcdfGroup:
    """Content of a group; netCDF keeps single numbers as arrays of one."""
    import h5py

    arrays = {
        name: (one.asstr() if h5py.check_string_dtype(one.dtype) else one)[...]
        for name, one in group.items()
        if isinstance(one, h5py.Dataset)
    }
    attrs = {
        name: value[0] if isinstance(value, np.ndarray) and value.shape == (1,) else value
        for name, value in group.attrs.items()
    }
    return NetcdfGroup(arrays, attrs)


@contextmanager
def _checked(path: Path, limits: Limits = LIMITS) -> Iterator[h5py.File]:
    """Context with an open file whose arrays can be read."""
    import h5py

    with opened(path) as stream:
        budget = Budget(str(path), os.fstat(stream.fileno()).st_size, limits)
    with h5py.File(path, "r") as file:
        budget.refuse_content(_Announced(budget).bytes_of(file))
        yield file


_DEFLATE, _DEFLATE_RATIO = 1, 1032  # code of gzip in HDF5, and what zlib reaches at most
_COMPRESSORS = {_DEFLATE, 4, 32000}  # szip and lzf, which hold no more than a hundred times as much
_FILTERS = {2, 3, 5, 6}  # shuffle, fletcher32, nbit and scale-offset, of which sizes follow


class _Announced:
    """Bytes of arrays as a file announces them, each as often as a path leads to it.

    Links may lead to one group by more paths than can be followed: each group is visited once.
    """

    def __init__(self, budget: Budget) -> None:
        self._budget = budget
        self._clock = budget.clock()
        self._totals: dict[int, int] = {}  # by the address of a group that has been visited
        self._links = 0

    def bytes_of(self, group: h5py.Group, depth: int = 1) -> int:
        """Bytes in a group and those within it."""
        import h5py

        address = h5py.h5o.get_info(group.id).addr
        if address not in self._totals:
            self._budget.refuse_depth(depth, "groups")
            self._totals[address] = 0  # for a group within itself
            self._totals[address] = sum(self._member(group, name, depth) for name in group)
        return self._totals[address]

    def _member(self, group: h5py.Group, name: str, depth: int) -> int:
        import h5py

        self._links += 1
        self._budget.refuse_nodes(self._links, "groups and arrays")
        self._clock()
        link = group.get(name, getlink=True)
        one = group.get(name) if isinstance(link, h5py.HardLink) else None
        if isinstance(one, h5py.Group):
            return self.bytes_of(one, depth + 1)
        if isinstance(one, h5py.Dataset) and not one.external and not one.is_virtual:
            self._refuse_inflated(one)
            # a chunk is read whole, also where the array is smaller
            n = max(int(one.size or 0), math.prod(one.chunks or (0,)))
            return n * one.dtype.itemsize
        if not isinstance(one, h5py.Datatype):
            raise FormatError(
                f"{name!r} lies in another file",
                where=self._budget.where,
                do="restore it, or make it again",
            )
        return 0

    def _refuse_inflated(self, array: h5py.Dataset) -> None:
        """Refuse chunks of gzip that hold more than a chunk: HDF5 reads them to their end."""
        pipeline = array.id.get_create_plist()
        filters = [pipeline.get_filter(k)[0] for k in range(pipeline.get_nfilters())]
        compressors = [code for code in filters if code not in _FILTERS]
        if len(compressors) > 1 or not set(compressors) <= _COMPRESSORS:
            raise FormatError(
                "has an array whose compression is not read",
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
        for offset in large:
            self._clock()
            _, raw = array.id.read_direct_chunk(offset)
            if len(zlib.decompressobj().decompress(raw, room + 1)) > room:
                raise FormatError(
                    f"has a chunk of {size_text(room)} that holds more",
                    where=self._budget.where,
                    do=DAMAGED,
                )


# -- arrays of our own, each file with the fingerprint of what it belongs to -----------------------


def read_arrays(
    path: Path, fingerprint: str, what: str, names: Sequence[str] | None = None, *, do: str
) -> dict[str, NDArray[Any]]:
    """Arrays by name from a file of `write_arrays`.

    `fingerprint` is that of data and settings; `what`, with its article, is what the file has to
    be; `names` are required, by default those in the file; `do` is advice for a file that cannot be
    read.  FormatError when it is damaged, InputError when it is not there, or belongs to other data
    or settings.
    """
    try:
        with restoring(path, what, do=do):
            arrays, marks = hdf5_arrays(path, names)
            known = marks["fingerprint"]
    except InputError as error:  # of the path: its reader does not know what to do
        raise type(error)(error.cause, where=error.where, do=do) from error
    if not isinstance(known, str) or known != fingerprint:
        raise InputError(
            f"this is {what} of other data or settings",
            where=str(path),
            do="restore it, or start again with --force",
        )
    return arrays


class _Written(io.FileIO):
    """A file as HDF5 writes it; what the system refuses is raised once HDF5 has closed it.

    Of an error in between HDF5 fails again as it closes its file, and may end the process.
    """

    _refused: OSError | None = None

    def write(self, content: Any) -> int:
        left = memoryview(content)
        while len(left) and self._refused is None:
            try:
                left = left[super().write(left) :]
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
    """Write arrays by name to a file, whole or not at all.

    InputError when the system refuses to write.
    """
    import h5py

    with (
        atomic_path(path) as temporary,
        _Written(temporary, "w+") as stream,
        h5py.File(stream, "w") as file,
    ):
        for name, values in arrays.items():
            file[name] = values
        file.attrs["fingerprint"] = fingerprint
