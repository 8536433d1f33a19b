"""Pieces of a table of matches: units of reading, of transfer to a worker and of computing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from bayesdist.errors import InputError

if TYPE_CHECKING:
    from bayesdist.data.matches import MatchTable

__all__ = ["PIECE", "Piece", "TablePiece", "even_edges", "every_kth"]

PIECE = 2**20  # rows of a piece at most: as many as a row group of Parquet has by default


class Piece(Protocol):
    """Consecutive rows of a table of matches; can be pickled."""

    def __len__(self) -> int:
        """Rows."""

    def read(self) -> MatchTable:
        """Rows, with codes by the names of the whole table."""


@dataclass(frozen=True, eq=False)
class TablePiece:
    """Piece of a table in memory."""

    table: MatchTable

    def __len__(self) -> int:
        return len(self.table)

    def read(self) -> MatchTable:
        """Rows as a table."""
        return self.table


def even_edges(n: int, most: int) -> list[int]:
    """Edges 0, ..., n of parts of about equal size, of at most `most` rows."""
    return np.linspace(0, n, -(-n // most) + 1).astype(int).tolist()


def every_kth(n_rows: int, n: int) -> int:
    """Smallest k for which every k-th of `n_rows` rows makes no more than n."""
    if n < 1:
        raise InputError(f"a sample of {n} rows is asked for", do="ask for at least one")
    return max(1, -(-n_rows // n))
