"""Batches of rows: units of reading, of transfer to a worker and of computing."""

from __future__ import annotations

import numpy as np

from bayesdist.errors import InputError

BATCH = 2**20  # rows of a batch at most: as many as a row group of Parquet has by default


def batch_edges(n: int) -> list[int]:
    """Edges 0, ..., n of batches of about equal size."""
    return even_edges(n, BATCH)


def even_edges(n: int, most: int) -> list[int]:
    """Edges 0, ..., n of ranges of about equal size, of at most `most` rows."""
    return np.linspace(0, n, -(-n // most) + 1).astype(int).tolist()


def every_kth(n_rows: int, n: int) -> int:
    """Smallest k for which every k-th of `n_rows` rows makes no more than n."""
    if n < 1:
        raise InputError(f"a sample of {n} rows is asked for", do="ask for at least one")
    return max(1, -(-n_rows // n))
