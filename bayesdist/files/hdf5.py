"""HDF5 and netCDF files, whose arrays are no larger than their file allows."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import FormatError, InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.files.faults import restoring
from bayesdist.files.regular import opened
from bayesdist.files.unpacked import refuse_inflated

if TYPE_CHECKING:
    import h5py


def hdf5_arrays(
    path: Path, names: Sequence[str] | None = None
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays by name, and attributes, of an HDF5 file.

    `names`: arrays that are wanted; by default all at the top of the file. InputError for a path
    that is no regular file. FormatError for arrays that the file cannot hold. OSError, KeyError as
    h5py raises them for a damaged file.
    """
    with _checked(path) as file:
        arrays = {name: file[name][...] for name in names or file}
        return arrays, dict(file.attrs)


@dataclass(frozen=True)
class NetcdfGroup:
    """Variables of a group of a netCDF file, in memory, and its attributes."""

    arrays: dict[str, NDArray[Any]]
    attrs: dict[str, Any]


def netcdf_groups(path: Path) -> dict[str, NetcdfGroup]:
    """Groups of a netCDF file by their names, '' at its top; errors as of `hdf5_arrays`.

    A tree of xarray takes five times as long, and half a second to import.
    """
    import h5py

    with _checked(path) as file:
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
def _checked(path: Path) -> Iterator[h5py.File]:
    """Context with an open file whose arrays can be read."""
    import h5py

    with opened(path) as stream:
        size = os.fstat(stream.fileno()).st_size
    with h5py.File(path, "r") as file:
        refuse_inflated(_bytes_of(file, str(path)), size, str(path))
        yield file


def _bytes_of(group: h5py.Group, where: str) -> int:
    """Bytes of the arrays in a group and those within it, as they are announced."""
    import h5py

    total = 0
    for name in group:
        link = group.get(name, getlink=True)
        one = group.get(name) if isinstance(link, h5py.HardLink) else None
        if isinstance(one, h5py.Group):
            total += _bytes_of(one, where)
        elif isinstance(one, h5py.Dataset) and not one.external and not one.is_virtual:
            total += int(one.size or 0) * one.dtype.itemsize
        elif not isinstance(one, h5py.Datatype):
            raise FormatError(
                f"{name!r} lies in another file", where=where, do="restore it, or make it again"
            )
    return total


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
