"""Blocks of a chain, and the files they are kept in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import InputError
from bayesdist.infer.sampler.checkpoints import new_hdf5

__all__ = ["Block", "Walkers", "block_path", "read_block", "write_block"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Walkers:
    """Where an ensemble stands.

    Parameters
    ----------
    coords : ndarray, shape (walkers, D)
        psi where proposals are drawn ahead, otherwise whitened.
    log_prob : ndarray, shape (walkers,)
    log_q : ndarray, shape (walkers,)
        Log proposal density; NaN where no move needs it.
    random : tuple
        State of emcee's random numbers, as `numpy.random.RandomState.get_state` gives it.
    """

    coords: Float
    log_prob: Float
    log_q: Float
    random: tuple


@dataclass(frozen=True, eq=False)
class Block:
    """Some steps of one ensemble.

    Parameters
    ----------
    coords : ndarray, shape (steps kept, walkers, D)
        In the coordinates of `Walkers`.
    log_prob : ndarray, shape (steps kept, walkers)
    accepted : ndarray, shape (walkers,)
        Number of accepted moves of each walker among the steps kept.
    log_weights : ndarray, shape (proposals,)
        Log importance weights of proposals that were drawn ahead; NaN outside the support.
    end : Walkers
        After the last step.
    """

    coords: Float
    log_prob: Float
    accepted: Float
    log_weights: Float
    end: Walkers


def block_path(folder: Path, ensemble: int, end: int) -> Path:
    """File of the block of an ensemble (from 0) that ends at a step."""
    return folder / f"chain-{ensemble + 1}-{end:06d}.h5"


def write_block(path: Path, mark: str, block: Block) -> None:
    """Keep a block; `mark` says to what it belongs."""
    with new_hdf5(path) as file:
        file["chain"], file["log_prob"] = block.coords, block.log_prob
        file["accepted"], file["log_weights"] = block.accepted, block.log_weights
        file["end_log_q"] = block.end.log_q
        _, file["random_keys"], position, has_gauss, gauss = block.end.random
        file.attrs["belongs_to"] = mark
        file.attrs["random_position"] = position
        file.attrs["random_has_gauss"] = has_gauss
        file.attrs["random_gauss"] = gauss


def read_block(path: Path, mark: str) -> Block:
    """Read a block back.

    Raises
    ------
    InputError
        When the file cannot be read, or is marked otherwise.
    """
    try:
        with h5py.File(path, "r") as file:
            if file.attrs["belongs_to"] != mark:
                raise KeyError("belongs_to")
            random = (
                "MT19937",
                file["random_keys"][...],
                int(file.attrs["random_position"]),
                int(file.attrs["random_has_gauss"]),
                float(file.attrs["random_gauss"]),
            )
            coords, log_prob = file["chain"][...], file["log_prob"][...]
            end = Walkers(coords[-1], log_prob[-1], file["end_log_q"][...], random)
            return Block(coords, log_prob, file["accepted"][...], file["log_weights"][...], end)
    except (OSError, KeyError) as error:
        raise InputError(
            "the checkpoint cannot be read, or belongs to another run",
            where=str(path),
            do="delete it and resume: its steps are run again",
        ) from error
