"""Write matches, or any columns, to Parquet files.

Folders with several files are parts of one table.
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.batches import BATCH
from bayesdist.data.columns import DEFAULT_LABELS, LABELS_OF_CODES
from bayesdist.data.matches import Matches
from bayesdist.data.output import geometry_header
from bayesdist.data.tables.checks import columns_of
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path, made_folder
from bayesdist.files.parquet import HEADER, arrow_array
from bayesdist.utils.arrays import Int

if TYPE_CHECKING:
    import pyarrow

Labelled = tuple[Int, tuple[str, ...]]
# columns, their units, and header values that no column holds
Part = tuple[Mapping[str, NDArray[Any] | Labelled], Mapping[str, str], Mapping[str, Any]]
_NUMBERS = (
    *("x", "y", "u", "v", "sigma_u", "sigma_v", "rho_uv", "epoch", "mag", "colour"),
    *("u_nominal", "v_nominal"),
)
_LENGTHS = ("u", "v", "sigma_u", "sigma_v", "u_nominal", "v_nominal")


def write_partitioned(
    tables: Iterable[Matches],
    folder: str | os.PathLike[str],
    *,
    rows_per_group: int = BATCH,
) -> list[Path]:
    """Write tables of matches as a folder of Parquet files, which are parts of one table.

    Only one of the tables needs to be in memory at a time. Reading the folder gives bit-identical
    numbers, with the tangent point and the match radius. Not written are the rows and files of
    origin, counts of rejected rows, labels without stars, and exposures, chips and filters if the
    first table has only the default label.

    Parameters
    ----------
    tables : iterable of Matches
        Tables in one unit, with the same columns.
    folder : path-like
        Output folder, which is created if necessary and must not contain Parquet files.
    rows_per_group : int, optional
        Largest number of rows in a row group.

    Returns
    -------
    list of pathlib.Path
        ``part-00000.parquet`` and so on, one per table. If a file cannot be written, or if the
        iterable raises an error, the files written so far are removed.

    Raises
    ------
    InputError
        If there are no tables, if tables differ in columns or unit, or if the folder cannot be
        written to or is in use.

    Examples
    --------
    >>> from bayesdist.data import write_partitioned
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, _ = simulate_wise(500, rng=np.random.default_rng(1))
    >>> [path.name for path in write_partitioned([matches, matches], "stars")]
    ['part-00000.parquet', 'part-00001.parquet']
    """
    folder = Path(folder)
    if rows_per_group < 1:
        raise InputError(f"rows_per_group is {rows_per_group}", do="give 1 or more")
    _make_empty(folder)
    written = write_parts(folder, _parts(tables, folder), rows_per_group=rows_per_group)
    if not written:
        raise InputError("there are no tables to write", where=str(folder), do="give at least one")
    return written


def write_parts(
    folder: Path, parts: Iterable[Part], *, rows_per_group: int | None = None
) -> list[Path]:
    """Write parts to the files part-00000.parquet and so on in a folder; return their paths.

    Each part has the columns, the units and the header of a file.  All files are removed if one
    fails.
    """
    written: list[Path] = []
    try:
        for columns, units, header in parts:
            path = folder / f"part-{len(written):05d}.parquet"
            write_columns(path, columns, units, header=header, rows_per_group=rows_per_group)
            written.append(path)
    except BaseException:
        for path in written:
            path.unlink(missing_ok=True)
        raise
    return written


def write_columns(
    path: str | os.PathLike[str],
    columns: Mapping[str, NDArray[Any] | Labelled],
    units: Mapping[str, str],
    *,
    header: Mapping[str, Any] | None = None,
    rows_per_group: int | None = None,
) -> None:
    """Write a Parquet file atomically, with units in the metadata of its fields.

    `columns` are arrays (N,), or codes with their labels, which are stored as a dictionary.
    `header` is stored as JSON in the metadata of the file.  `rows_per_group` is the number of rows
    in a row group.
    """
    import pyarrow.parquet

    fields, arrays = [], []
    for name, values in columns.items():
        array = _labelled(*values) if isinstance(values, tuple) else arrow_array(values)
        metadata = {"unit": units[name]} if name in units else None
        fields.append(pyarrow.field(name, array.type, nullable=False, metadata=metadata))
        arrays.append(array)
    metadata_of_file = {HEADER: json.dumps(dict(header))} if header else None
    table = pyarrow.table(arrays, schema=pyarrow.schema(fields, metadata=metadata_of_file))
    with atomic_path(path) as temporary:
        pyarrow.parquet.write_table(
            table,
            temporary,
            row_group_size=rows_per_group,
            # measurements do not compress well; labels are run-length encoded in any case
            compression="none",
            use_dictionary=[name for name, v in columns.items() if isinstance(v, tuple)],
            write_statistics=False,
            write_page_checksum=True,  # to detect damage
        )
    pyarrow.default_memory_pool().release_unused()


def _parts(tables: Iterable[Matches], folder: Path) -> Iterator[Part]:
    """Columns and units of tables, which must be those of the first table."""
    names: list[str] = []
    unit = ""
    for number, table in enumerate(tables, 1):
        columns = _columns(table, names)
        if number == 1:
            names, unit = list(columns), table.unit
        elif list(columns) != names or table.unit != unit:
            raise InputError(
                f"table {number} has another unit or other columns than the first",
                where=str(folder),
                do="give tables of one kind",
            )
        units = dict.fromkeys(_LENGTHS, unit) | {"x": "pix", "y": "pix", "epoch": "yr"}
        yield columns, units, geometry_header(table)


def _columns(table: Matches, names: Collection[str]) -> dict[str, NDArray[Any] | Labelled]:
    """Columns of a table; labels only if they are not the default or if `names` contains them."""
    columns: dict[str, Any] = columns_of(table, (*_NUMBERS, "star"))
    for name, key in LABELS_OF_CODES.items():
        labels = getattr(table, key)
        if labels != (DEFAULT_LABELS[name],) or name in names:
            columns[name] = (getattr(table, name), labels)
    return columns


def _make_empty(folder: Path) -> None:
    made_folder(folder)
    if next(folder.rglob("*.parquet"), None) is not None:
        raise InputError(
            "holds Parquet files already", where=str(folder), do="choose an empty folder"
        )


def _labelled(codes: Int, labels: Sequence[str | int]) -> pyarrow.DictionaryArray:
    """Column of labels from codes that refer to them."""
    import pyarrow

    return pyarrow.DictionaryArray.from_arrays(
        arrow_array(codes.astype(np.int32)), arrow_array(np.asarray(labels))
    )
