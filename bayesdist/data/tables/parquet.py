"""Parquet files, read block by block with the memory of one block, whatever their size.

Errors about damage name the row group. Page checksums are verified if the file has them; without
them, a flipped bit in a number cannot be detected.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesdist.data.tables.checks import Place
from bayesdist.data.tables.column import EncodedColumn
from bayesdist.errors import InputError
from bayesdist.files.budget import Budget
from bayesdist.files.faults import naming_faults
from bayesdist.files.parquet import (
    nested_texts,
    numpy_array,
    open_parquet,
    parquet_column,
    parquet_header,
    parquet_units,
    refuse_long_text,
    text_columns,
)
from bayesdist.utils.arrays import Int

if TYPE_CHECKING:
    import pyarrow
    import pyarrow.parquet

_BATCH = 65_536  # rows decoded at a time


@dataclass(frozen=True, eq=False)
class RowBlock:
    """Consecutive rows of a file, with the columns that an astropy Table would have."""

    first: int  # index in the file of the first row, counted from 0
    columns: Mapping[str, pyarrow.ChunkedArray]
    units: Mapping[str, str]
    encoded: Collection[str]  # columns that are returned as `EncodedColumn`

    @property
    def colnames(self) -> list[str]:
        """Names of the columns."""
        return list(self.columns)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def __getitem__(self, name: str) -> Any:
        column = self.columns[name]
        if name in self.encoded:
            encoded = _encoded(column, self.units.get(name))
            if encoded is not None:
                return encoded
        return parquet_column(column, self.units.get(name))


@dataclass(frozen=True, eq=False)
class ParquetPart:
    """Description of a Parquet file without its rows."""

    path: Path  # absolute, so that it is valid in any working folder
    name: str  # path as given, for messages
    group_rows: tuple[int, ...]  # rows of each row group
    colnames: tuple[str, ...]
    units: Mapping[str, str]
    texts: frozenset[str]  # columns of strings or dictionaries
    header: Mapping[str, Any]  # header values stored with the table

    @property
    def n_rows(self) -> int:
        """Number of rows in the file."""
        return int(self._edges[-1])

    @cached_property
    def _edges(self) -> Int:
        return np.cumsum([0, *self.group_rows])

    def _group_of(self, row: int) -> int:
        """Row group of a row, both counted from 0."""
        return int(np.searchsorted(self._edges, row, side="right")) - 1

    def _group_name(self, group: int) -> str:
        return f"row group {group + 1} of {len(self.group_rows)}"

    def place(self, first: int) -> Place:
        """Function that names a row by its row group and number (from 1).

        Its argument is the offset of the row from the row `first`.
        """

        def name(index: int) -> str:
            row = first + index
            return f"{self._group_name(self._group_of(row))}, row {row + 1}"

        return name

    def blocks(
        self,
        columns: Sequence[str],
        *,
        encoded: Collection[str] = (),
        start: int = 0,
        stop: int | None = None,
        size: int,
    ) -> Iterator[RowBlock]:
        """Blocks of rows `start` to `stop` (counted from 0), of at most `size` rows each.

        Columns in `encoded` are returned as `EncodedColumn`. Raises InputError if the file is
        damaged, missing, or has changed since it was described.
        """
        import pyarrow

        stop = self.n_rows if stop is None else stop
        batches: list[pyarrow.RecordBatch] = []
        held = 0
        for batch in self._batches(columns, start, stop):
            while len(batch):
                head = batch.slice(0, size - held)
                batch = batch.slice(len(head))
                batches.append(head)
                held += len(head)
                start += len(head)
                if held == size or start == stop:
                    table = pyarrow.Table.from_batches(batches)
                    arrays = dict(zip(table.column_names, table.columns, strict=True))
                    batches = []
                    yield RowBlock(start - held, arrays, self.units, encoded)
                    held = 0
        if start != stop:
            raise self._changed()

    def _batches(
        self, columns: Sequence[str], start: int, stop: int
    ) -> Iterator[pyarrow.RecordBatch]:
        """Record batches as they are decoded."""
        import pyarrow

        if start >= stop:
            return
        groups = list(range(self._group_of(start), self._group_of(stop - 1) + 1))
        at = int(self._edges[groups[0]])
        # a string that is stored once may occur in all rows, so it is decoded only once
        with _opened(self.path, self.name, self.texts) as stored:
            budget = Budget(self.name, self.path.stat().st_size)
            if _group_rows(stored) != self.group_rows or _names(stored) != self.colnames:
                raise self._changed()
            for column in sorted(nested_texts(stored).intersection(columns)):
                raise InputError(
                    "a cell contains several strings",
                    where=f"{self.name}, column {column!r}",
                    do="give a column with one value in each row",
                )
            # only next() is guarded, because errors in the code that uses the rows are not the
            # file's fault
            decoded = stored.iter_batches(_BATCH, row_groups=groups, columns=list(columns))
            while True:
                try:
                    batch = next(decoded, None)
                except Exception as error:
                    raise self._damage(stored, columns, at, groups, error) from error
                if batch is None:
                    break
                end = at + len(batch)
                for column in batch.columns:
                    refuse_long_text(column, budget)
                if end > start:
                    yield batch.slice(max(0, start - at), min(end, stop) - max(start, at))
                at = end
                if at >= stop:
                    break
            del decoded, batch
        pyarrow.default_memory_pool().release_unused()

    def _damage(
        self,
        stored: pyarrow.parquet.ParquetFile,
        columns: Sequence[str],
        reached: int,
        groups: Sequence[int],
        error: Exception,
    ) -> InputError:
        """Error about the first row group that cannot be read."""
        location = self.name
        for group in groups:
            if self._edges[group + 1] <= reached:
                continue
            try:
                for _ in stored.iter_batches(_BATCH, row_groups=[group], columns=list(columns)):
                    pass
            except Exception as found:
                error = found
                first, last = self._edges[group] + 1, self._edges[group + 1]
                location = f"{self.name}, {self._group_name(group)} (rows {first} to {last})"
                break
        return _as_input_error(Path(self.name), location, error)

    def _changed(self) -> InputError:
        return InputError("has changed since it was opened", where=self.name, do="start again")


def describe_part(path: Path) -> ParquetPart:
    """Description of a Parquet file from its footer.

    Raises InputError if the file is missing or damaged.
    """
    with _opened(path, str(path)) as stored, naming_faults(path):
        schema = stored.schema_arrow
        return ParquetPart(
            path.absolute(),
            str(path),
            _group_rows(stored),
            _names(stored),
            parquet_units(schema),
            text_columns(schema),
            parquet_header(schema),
        )


@contextmanager
def _opened(
    path: Path, name: str, as_codes: Collection[str] = ()
) -> Iterator[pyarrow.parquet.ParquetFile]:
    """Open a file so that only the part being decoded is in memory."""
    with naming_faults(Path(name)):
        stored = open_parquet(path, as_codes)
    with stored:
        yield stored


def _group_rows(stored: pyarrow.parquet.ParquetFile) -> tuple[int, ...]:
    metadata = stored.metadata
    return tuple(metadata.row_group(k).num_rows for k in range(metadata.num_row_groups))


def _names(stored: pyarrow.parquet.ParquetFile) -> tuple[str, ...]:
    return tuple(stored.schema_arrow.names)


def _as_input_error(path: Path, where: str, error: Exception) -> InputError:
    try:
        with naming_faults(path, where):
            raise error
    except InputError as named:
        return named


def _encoded(values: pyarrow.ChunkedArray, unit: str | None) -> EncodedColumn | None:
    """Codes and labels of a column; None if it has nulls or a type without equality."""
    import pyarrow

    try:
        array = values.combine_chunks()
        if not pyarrow.types.is_dictionary(array.type):
            array = array.dictionary_encode()
    except pyarrow.ArrowException:
        return None
    if array.null_count or array.dictionary.null_count:
        return None
    labels = numpy_array(array.dictionary)
    codes = numpy_array(array.indices).astype(np.int64)
    # a dictionary in the file may be in another order, and may have unused labels
    n = len(codes)
    first = np.full(len(labels), n)
    first[codes[::-1]] = np.arange(n - 1, -1, -1)
    order = np.argsort(first)[: int((first < n).sum())]
    rank = np.zeros(len(labels), np.int64)
    rank[order] = np.arange(len(order))
    return EncodedColumn(rank[codes], labels[order], unit)
