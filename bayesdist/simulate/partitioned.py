"""Simulated matches that need not fit into memory."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from bayesdist.data.batches import even_edges
from bayesdist.data.matches import Matches
from bayesdist.data.storage.write import write_partitioned
from bayesdist.simulate.matches import Truth

__all__ = ["simulate_partitioned"]

CHUNK = 1_000_000  # matches in memory at a time


def simulate_partitioned(
    folder: str | os.PathLike[str], n: int, simulate: Callable[[int], tuple[Matches, Truth]]
) -> Truth:
    """Truth of matched stars that are written to a folder of Parquet files as they come.

    Parameters
    ----------
    folder : path-like
        As `write_partitioned`.
    n : int
    simulate : callable
        Makes so many matches, at most `CHUNK`, and their truth.

    Returns
    -------
    Truth
        `false` has one byte for each pair, in the order of the files.

    Raises
    ------
    InputError
        As `simulate` and `write_partitioned`.
    """
    truths: list[Truth] = []
    edges = even_edges(n, CHUNK)

    def chunks() -> Iterator[Matches]:
        for size in np.diff(edges).tolist():
            matches, truth = simulate(size)
            truths.append(truth)
            yield matches

    write_partitioned(chunks(), folder)
    return replace(truths[0], false=np.concatenate([truth.false for truth in truths]))
