"""Pairs of WISE and 2MASS that need not fit into memory."""

from __future__ import annotations

import os

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.missions.wise.simulate.published import SAMPLE_SIZES
from bayesdist.missions.wise.simulate.solution import simulate_wise
from bayesdist.simulate.matches import Truth
from bayesdist.simulate.partitioned import simulate_partitioned

__all__ = ["simulate_wise_partitioned"]


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

    Up to a million pairs are those of `simulate_wise`.

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

    def simulate(size: int) -> tuple[Matches, Truth]:
        return simulate_wise(
            size,
            band=band,
            rng=rng,
            fraction=fraction,
            jitter=jitter,
            outlier_scale=outlier_scale,
        )

    return simulate_partitioned(folder, n, simulate)
