"""Batches of rows, which are read, sent to a worker and processed as one unit."""

from __future__ import annotations

import numpy as np

from bayesdist.errors import InputError

BATCH = 2**20  # largest number of rows in a batch, the default size of a Parquet row group


def even_edges(n: int, most: int) -> list[int]:
    """Edges 0, ..., n of ranges of nearly equal size with at most `most` rows each."""
    return np.linspace(0, n, -(-n // most) + 1).astype(int).tolist()


def every_kth(n_rows: int, n: int) -> int:
    """Smallest k for which every k-th of `n_rows` rows gives a sample of at most n rows.

    Raises InputError if n is less than one.
    """
    if n < 1:
        raise InputError(f"a sample of {n} rows is requested", do="ask for at least one")
    return max(1, -(-n_rows // n))
