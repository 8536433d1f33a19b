"""Columns to Parquet."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.files import atomic_path

if TYPE_CHECKING:
    import pyarrow

__all__ = ["labelled", "save_parquet", "write_columns"]

Labelled = tuple[NDArray[np.int64], tuple[str, ...]]


def write_columns(
    path: str | os.PathLike[str],
    columns: Mapping[str, NDArray[Any] | Labelled],
    units: Mapping[str, str],
) -> None:
    """Write a Parquet file, with units in the metadata of its fields.

    Parameters
    ----------
    path : path-like
        Replaced atomically.
    columns : mapping of str to ndarray, shape (N,)
        Or codes and the labels that they stand for, kept as a dictionary.
    units : mapping of str to str
        Of the columns that have one.

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    import pyarrow

    fields, arrays = [], []
    for name, values in columns.items():
        array = labelled(*values) if isinstance(values, tuple) else pyarrow.array(values)
        metadata = {"unit": units[name]} if name in units else None
        fields.append(pyarrow.field(name, array.type, nullable=False, metadata=metadata))
        arrays.append(array)
    save_parquet(pyarrow.table(arrays, schema=pyarrow.schema(fields)), path)
    pyarrow.default_memory_pool().release_unused()


def labelled(codes: NDArray[np.int64], labels: Sequence[str | int]) -> pyarrow.DictionaryArray:
    """A column of labels, by codes into them."""
    import pyarrow

    return pyarrow.DictionaryArray.from_arrays(
        pyarrow.array(codes, pyarrow.int32()), pyarrow.array(labels)
    )


def save_parquet(
    table: pyarrow.Table, path: str | os.PathLike[str], *, rows_per_group: int | None = None
) -> None:
    """Write a table; pages carry checksums, so that damage is seen.

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    import pyarrow
    import pyarrow.parquet

    with atomic_path(path) as temporary:
        pyarrow.parquet.write_table(
            table,
            temporary,
            row_group_size=rows_per_group,
            # measured numbers do not compress; labels are run-length encoded all the same
            compression="none",
            use_dictionary=[
                one.name for one in table.schema if pyarrow.types.is_dictionary(one.type)
            ],
            write_statistics=False,
            write_page_checksum=True,
        )
