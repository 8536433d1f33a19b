"""Data sets of known truth that need not fit into memory."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from bayesdist.data.matches import MatchTable
from bayesdist.data.pieces import even_edges
from bayesdist.data.write import write_partitioned
from bayesdist.simulate.matches import Truth
from bayesdist.simulate.wise import SAMPLE_SIZES, simulate_wise

__all__ = ["simulate_wise_partitioned"]

CHUNK = 1_000_000  # pairs in memory at a time


def simulate_wise_partitioned(
    folder: str | os.PathLike[str],
    n: int = SAMPLE_SIZES["W2"],
    *,
    band: str = "W2",
    rng: np.random.Generator,
    fraction: float = 0.03,
    jitter: float = 0.03,
    outlier_scale: float = 1.0,
) -> Truth:
    """Pairs of WISE detections and 2MASS stars, written to a folder of Parquet files as they come.

    Up to `CHUNK` pairs are those of `simulate_wise`.

    Parameters
    ----------
    folder : path-like
        As `write_partitioned`.
    n : int, optional
    band, rng, fraction, jitter, outlier_scale
        As `simulate_wise`.

    Returns
    -------
    Truth
        `false` has one byte for each pair, in the order of the files.

    Raises
    ------
    InputError
        As `simulate_wise` and `write_partitioned`.
    """
    truths: list[Truth] = []
    edges = even_edges(n, CHUNK)

    def chunks() -> Iterator[MatchTable]:
        for size in np.diff(edges).tolist():
            matches, truth = simulate_wise(
                size,
                band=band,
                rng=rng,
                fraction=fraction,
                jitter=jitter,
                outlier_scale=outlier_scale,
            )
            truths.append(truth)
            yield matches

    write_partitioned(chunks(), folder)
    return replace(truths[0], false=np.concatenate([truth.false for truth in truths]))
