"""Checkpoint files of arrays for resumed runs, each with the fingerprint of its run.

The steps of a chain are stored block by block.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.files.faults import restoring
from bayesdist.files.hdf5 import hdf5_arrays
from bayesdist.utils.arrays import Float

BLOCK_ARRAYS = ("coords", "log_prob", "accepted", "log_weights")
END_ARRAYS = ("log_q", "random_keys", "random_state")


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


@contextmanager
def _new_hdf5(path: Path) -> Iterator[h5py.File]:
    """Context with a file to be filled, which is written whole or not at all.

    InputError when the system refuses to write.
    """
    with (
        atomic_path(path) as temporary,
        _Written(temporary, "w+") as stream,
        h5py.File(stream, "w") as file,
    ):
        yield file


def read_arrays(
    path: Path, fingerprint: str, names: Sequence[str] | None = None, *, do: str
) -> dict[str, NDArray[Any]]:
    """Arrays by name from a file of `write_arrays`.

    `fingerprint` is that of data and settings; `names` are required, by default those in the file;
    `do` is advice for a file that cannot be read.  InputError when it cannot, or belongs to other
    data or settings.
    """
    try:
        arrays, marks = hdf5_arrays(path, names)
        known = marks["fingerprint"]
    except InputError as error:
        raise InputError(error.cause, where=error.where, do=do) from error
    except Exception as error:  # HDF5 raises errors of all kinds on damaged files
        raise InputError("the checkpoint cannot be read", where=str(path), do=do) from error
    if not isinstance(known, str) or known != fingerprint:
        raise InputError(
            "the checkpoints belong to other data or settings",
            where=str(path.parent),
            do="restore them, or start again with --force",
        )
    return arrays


def write_arrays(path: Path, fingerprint: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays by name to a file, whole or not at all."""
    with _new_hdf5(path) as file:
        for name, values in arrays.items():
            file[name] = values
        file.attrs["fingerprint"] = fingerprint


@dataclass(frozen=True, eq=False)
class Walkers:
    """State of an ensemble."""

    coords: Float  # (walkers, D) psi where proposals are drawn ahead, otherwise whitened
    log_prob: Float
    log_q: Float  # log proposal density (walkers,); NaN where no move needs it
    random: tuple  # state of emcee's random numbers, from `numpy.random.RandomState.get_state`


@dataclass(frozen=True, eq=False)
class Block:
    """Some steps of one ensemble."""

    coords: Float  # (steps stored, walkers, D) in the coordinates of `Walkers`
    log_prob: Float  # (steps stored, walkers)
    accepted: Float  # number (walkers,) of accepted moves of each walker among the steps stored
    # log importance weights (proposals,) of proposals drawn ahead; NaN outside the support
    log_weights: Float
    end: Walkers  # after the last step

    def write(self, path: Path, mark: str) -> None:
        """Write the block to a file; `mark` identifies the run."""
        arrays = {name: getattr(self, name) for name in BLOCK_ARRAYS}
        _, keys, *state = self.end.random
        end = (self.end.log_q, keys, np.array(state))
        write_arrays(path, mark, arrays | dict(zip(END_ARRAYS, end, strict=True)))

    @classmethod
    def read(cls, path: Path, mark: str) -> Block:
        """Block from a file; InputError when it cannot be read, or has another mark."""
        do = "delete it and resume: its steps are run again"
        stored = read_arrays(path, mark, (*BLOCK_ARRAYS, *END_ARRAYS), do=do)
        with restoring(path, "a checkpoint", do=do):
            log_q, keys, (position, has_gauss, gauss) = (stored.pop(name) for name in END_ARRAYS)
            random = ("MT19937", keys, int(position), int(has_gauss), float(gauss))
            np.random.RandomState().set_state(random)  # refuses what is no such state
            end = Walkers(stored["coords"][-1], stored["log_prob"][-1], log_q, random)
            return cls(**stored, end=end)


def block_path(folder: Path, ensemble: int, end: int) -> Path:
    """File of the block of an ensemble (from 0) that ends at a step."""
    return folder / f"chain-{ensemble + 1}-{end:06d}.h5"
