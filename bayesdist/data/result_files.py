"""Columns of results to Parquet."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.files import atomic_path

__all__ = ["write_columns"]

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
    import pyarrow.parquet

    fields, arrays = [], []
    for name, values in columns.items():
        if isinstance(values, tuple):
            codes, labels = values
            array = pyarrow.DictionaryArray.from_arrays(
                pyarrow.array(codes, pyarrow.int32()), pyarrow.array(labels, pyarrow.string())
            )
        else:
            array = pyarrow.array(values)
        metadata = {"unit": units[name]} if name in units else None
        fields.append(pyarrow.field(name, array.type, nullable=False, metadata=metadata))
        arrays.append(array)
    table = pyarrow.table(arrays, schema=pyarrow.schema(fields))
    labelled = [name for name, values in columns.items() if isinstance(values, tuple)]
    with atomic_path(path) as temporary:
        pyarrow.parquet.write_table(
            table,
            temporary,
            # residuals do not compress
            compression="none",
            use_dictionary=labelled,
            write_statistics=False,
            write_page_checksum=True,
        )
    pyarrow.default_memory_pool().release_unused()
