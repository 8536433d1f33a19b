"""Arrays that a resumed run takes up again, in files that say to what they belong."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
from numpy.typing import NDArray

from bayesdist.errors import InputError
from bayesdist.files import atomic_path

__all__ = ["new_hdf5", "read_arrays", "write_arrays"]


@contextmanager
def new_hdf5(path: Path) -> Iterator[h5py.File]:
    """A file to be filled, which appears whole or not at all.

    It is made in memory: where a disk is full, HDF5 fails again as it closes its file, and may end
    the process.

    Raises
    ------
    InputError
        When the system refuses to write.
    """
    with atomic_path(path) as temporary:
        with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
            yield file
            file.flush()
            content = file.id.get_file_image()
        temporary.write_bytes(content)


def read_arrays(
    path: Path, fingerprint: str, names: Sequence[str] | None = None, *, do: str
) -> dict[str, NDArray[Any]]:
    """What `write_arrays` kept.

    Parameters
    ----------
    path : Path
    fingerprint : str
        Of data and settings.
    names : sequence of str, optional
        Arrays that must be there; all that are by default.
    do : str
        Advice for a file that cannot be read.

    Raises
    ------
    InputError
        When the file cannot be read, or belongs to other data or settings.
    """
    try:
        with h5py.File(path, "r") as file:
            known = file.attrs["fingerprint"]
            arrays = {name: file[name][...] for name in names or file}
    except (OSError, KeyError) as error:
        raise InputError("the checkpoint cannot be read", where=str(path), do=do) from error
    if known != fingerprint:
        raise InputError(
            "the checkpoints belong to other data or settings",
            where=str(path.parent),
            do="restore them, or start again with --force",
        )
    return arrays


def write_arrays(path: Path, fingerprint: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Keep arrays by name; the file appears whole or not at all."""
    with new_hdf5(path) as file:
        for name, values in arrays.items():
            file[name] = values
        file.attrs["fingerprint"] = fingerprint
