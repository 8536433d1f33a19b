"""HDF5 and netCDF files, whose arrays are no larger than their file allows."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from numpy.typing import NDArray

from bayesdist.errors import FormatError
from bayesdist.reading.regular import opened
from bayesdist.reading.unpacked import refuse_inflated

if TYPE_CHECKING:
    import h5py
    import xarray as xr

NETCDF_ENGINE: Final = "h5netcdf"


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


def netcdf_tree(path: Path) -> xr.DataTree:
    """Groups of a netCDF file, in memory; errors as of `hdf5_arrays`."""
    import xarray as xr

    with _checked(path):
        pass
    with xr.open_datatree(path, engine=NETCDF_ENGINE) as tree:
        tree.load()
    return tree


def netcdf_dataset(path: Path) -> xr.Dataset:
    """Variables at the top of a netCDF file, in memory; errors as of `hdf5_arrays`."""
    import xarray as xr

    with _checked(path):
        pass
    with xr.open_dataset(path, engine=NETCDF_ENGINE) as data:
        data.load()
    return data


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
