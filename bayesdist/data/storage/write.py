"""Columns, and matches table by table as they come, to Parquet."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.batches import BATCH
from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.files import atomic_path, made_folder

if TYPE_CHECKING:
    import pyarrow

__all__ = ["write_columns", "write_partitioned"]

Labelled = tuple[NDArray[np.int64], tuple[str, ...]]

_NUMBERS = (
    *("x", "y", "u", "v", "sigma_u", "sigma_v", "epoch", "mag", "colour"),
    *("u_nominal", "v_nominal"),
)
_LABELS = {
    "exposure": ("exposure_names", ("1",)),
    "chip": ("chip_numbers", (1,)),
    "filter": ("filter_names", ("",)),
}


def write_partitioned(
    tables: Iterable[Matches],
    folder: str | os.PathLike[str],
    *,
    rows_per_group: int = BATCH,
) -> list[Path]:
    """Write tables of matches as a folder of Parquet files, parts of one table.

    Only one of the tables need be in memory at a time.  Reading the folder gives the same numbers
    bit for bit.  Not written are the rows and files that the stars come from, what was rejected,
    and the tangent point; labels that no star has; and exposures, chips and filters where the first
    table has none but the default.

    Parameters
    ----------
    tables : iterable of Matches
        Of one unit and with the same columns.
    folder : path-like
        It is made if need be, and must not hold Parquet files.
    rows_per_group : int, optional
        Rows of a row group at most.

    Returns
    -------
    list of pathlib.Path
        ``part-00000.parquet`` and so on, one for each table.  When one of them cannot be written,
        or the tables end in an error, those before it are removed.

    Raises
    ------
    InputError
        For no tables, tables that differ in their columns or unit, and a folder that cannot be
        written to or is in use.
    """
    folder = Path(folder)
    if rows_per_group < 1:
        raise InputError(f"rows_per_group is {rows_per_group}", do="give 1 or more")
    _make_empty(folder)
    written: list[Path] = []
    schema: pyarrow.Schema | None = None
    try:
        for table in tables:
            path = folder / f"part-{len(written):05d}.parquet"
            if schema is None:
                schema = _schema(table)
            elif _schema(table, like=schema) != schema:
                raise InputError(
                    f"table {len(written) + 1} has another unit or other columns than the first",
                    where=str(folder),
                    do="give tables of one kind",
                )
            _write(table, schema, path, rows_per_group)
            written.append(path)
    except BaseException:
        for path in written:
            path.unlink(missing_ok=True)
        raise
    if not written:
        raise InputError("there are no tables to write", where=str(folder), do="give at least one")
    return written


def _make_empty(folder: Path) -> None:
    made_folder(folder)
    if next(folder.rglob("*.parquet"), None) is not None:
        raise InputError(
            "holds Parquet files already", where=str(folder), do="choose an empty folder"
        )


def _schema(table: Matches, *, like: pyarrow.Schema | None = None) -> pyarrow.Schema:
    """Columns of a table with their types and units.

    Labels are columns where there are other than the default, or where `like` has them.
    """
    import pyarrow

    units = {"x": "pix", "y": "pix", "epoch": "yr"}
    units |= dict.fromkeys(("u", "v", "sigma_u", "sigma_v", "u_nominal", "v_nominal"), table.unit)
    out = []
    for name in _NUMBERS:
        if getattr(table, name) is not None:
            metadata = {"unit": units[name]} if name in units else None
            out.append(pyarrow.field(name, pyarrow.float64(), metadata=metadata))
    if table.star is not None:
        out.append(pyarrow.field("star", pyarrow.int64()))
    for name, (labels, default) in _LABELS.items():
        if getattr(table, labels) != default or (like is not None and name in like.names):
            kind = pyarrow.int64() if name == "chip" else pyarrow.string()
            out.append(pyarrow.field(name, pyarrow.dictionary(pyarrow.int32(), kind)))
    return pyarrow.schema(out)


def _write(table: Matches, schema: pyarrow.Schema, path: Path, rows_per_group: int) -> None:
    import pyarrow

    columns = []
    for one in schema:
        values = getattr(table, one.name)
        if pyarrow.types.is_dictionary(one.type):
            columns.append(labelled(values, getattr(table, _LABELS[one.name][0])))
        else:
            columns.append(pyarrow.array(values))
    save_parquet(pyarrow.table(columns, schema=schema), path, rows_per_group=rows_per_group)


def write_columns(
    path: str | os.PathLike[str],
    columns: Mapping[str, NDArray[Any] | Labelled],
    units: Mapping[str, str],
) -> None:
    """Write a Parquet file, with units in the metadata of its fields; replaced atomically.

    `columns` are arrays (N,), or codes and the labels that they stand for, stored as a dictionary.
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
    """Write a table; pages carry checksums, so that damage is seen."""
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
