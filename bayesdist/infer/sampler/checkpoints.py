"""Checkpoints of the chains for resumed runs, in blocks of steps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayesdist.files.faults import restoring
from bayesdist.files.hdf5 import read_arrays, write_arrays
from bayesdist.utils.arrays import Float

CHECKPOINT = "a checkpoint"  # kind of file in error messages
BLOCK_ARRAYS = ("coords", "log_prob", "accepted", "log_weights")
END_ARRAYS = ("log_q", "random_keys", "random_state")


@dataclass(frozen=True, eq=False)
class Walkers:
    """State of the walkers of an ensemble."""

    coords: Float  # (walkers, D): psi for independence moves only, otherwise whitened coordinates
    log_prob: Float  # log posterior density (walkers,)
    log_q: Float  # log proposal density (walkers,); NaN if no move needs it
    random: tuple  # state of emcee's random generator, from `numpy.random.RandomState.get_state`


@dataclass(frozen=True, eq=False)
class Block:
    """Consecutive steps of one ensemble."""

    coords: Float  # (steps stored, walkers, D) in the coordinates of `Walkers`
    log_prob: Float  # (steps stored, walkers)
    accepted: Float  # number (walkers,) of accepted moves
    # log importance weights (proposals,) for independence moves; NaN outside the support
    log_weights: Float
    end: Walkers  # state after the last step

    def write(self, path: Path, mark: str) -> None:
        """Write the block to a file; `mark` identifies the run."""
        arrays = {name: getattr(self, name) for name in BLOCK_ARRAYS}
        _, keys, *state = self.end.random
        end = (self.end.log_q, keys, np.array(state))
        write_arrays(path, mark, arrays | dict(zip(END_ARRAYS, end, strict=True)))

    @classmethod
    def read(cls, path: Path, mark: str) -> Block:
        """Read a block; raises InputError if the file cannot be read or has another mark."""
        do = "delete it and resume: its steps are run again"
        stored = read_arrays(path, mark, CHECKPOINT, (*BLOCK_ARRAYS, *END_ARRAYS), do=do)
        with restoring(path, CHECKPOINT, do=do):
            log_q, keys, (position, has_gauss, gauss) = (stored.pop(name) for name in END_ARRAYS)
            random = ("MT19937", keys, int(position), int(has_gauss), float(gauss))
            np.random.RandomState().set_state(random)  # raises if the state is invalid
            end = Walkers(stored["coords"][-1], stored["log_prob"][-1], log_q, random)
            return cls(**stored, end=end)


def block_path(folder: Path, ensemble: int, end: int) -> Path:
    """Path of the block of an ensemble (numbered from 0) that ends at step `end`."""
    return folder / f"chain-{ensemble + 1}-{end:06d}.h5"
