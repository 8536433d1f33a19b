"""Tables in memory that are processed in small batches."""

from __future__ import annotations

from bayesdist.data import Matches


def in_batches(matches: Matches, rows: int) -> Matches:
    """The same matches, whose readers have at most `rows` rows each."""
    columns = [name for name in matches._columns if matches.has(name)]
    return Matches.from_readers(matches.readers(rows), matches.labels, columns)
