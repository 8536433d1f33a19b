"""How many pairs a second are simulated, in memory and on disk."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from bayesdist.missions.wise.published import WISE_BANDS
from bayesdist.missions.wise.simulate import wise_set, write_wise_set
from tests.benchmarks.timing import say

__all__ = ["FULL", "QUICK", "Sizes", "run"]


@dataclass(frozen=True)
class Sizes:
    """What is run."""

    bands: tuple[str, ...]
    pairs: int | None  # as published by default


FULL = Sizes(WISE_BANDS, None)
QUICK = Sizes(("W4",), 2000)


def run(sizes: Sizes) -> dict[str, Any]:
    """Seconds of each band: one chunk in one thread, and the whole set as Parquet.

    Parameters
    ----------
    sizes : Sizes

    Returns
    -------
    dict
    """
    threads = os.cpu_count() or 1
    rows = []
    for band in sizes.bands:
        one = wise_set(band, pairs=sizes.pairs, partition=True)
        start = time.perf_counter()
        made = len(one.chunk(0))
        chunk_s = time.perf_counter() - start
        with TemporaryDirectory() as folder:
            start = time.perf_counter()
            write_wise_set(one, Path(folder), threads=threads)
            write_s = time.perf_counter() - start
        rows.append(
            {
                "band": band,
                "n_pairs": one.pairs,
                "chunk_rate": made / chunk_s,
                "write_s": write_s,
                "write_rate": one.pairs / write_s,
            }
        )
        say(f"simulated {band}: {one.pairs:,} pairs in {write_s:.2f} s")
    return {"rows": rows, "threads": threads}
