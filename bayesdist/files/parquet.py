"""Parquet files: columns, units, and rows that fit into memory or are read in blocks."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from astropy.table import Column, MaskedColumn, Table
from astropy.table.meta import get_header_from_yaml
from numpy.typing import NDArray

from bayesdist.errors import FormatError
from bayesdist.files.budget import DAMAGED, LIMITS, Budget, FileLimits
from bayesdist.files.documents import refuse_multiplied_yaml
from bayesdist.files.regular import opened

if TYPE_CHECKING:
    import pyarrow
    import pyarrow.parquet

HEADER = "bayesdist"  # key of the metadata for properties of matches that are not in a column
_BUFFER = 2**18  # bytes; without a buffer, Arrow loads the columns of an entire row group


def open_parquet(
    path: Path, as_codes: Collection[str] = (), limits: FileLimits = LIMITS
) -> pyarrow.parquet.ParquetFile:
    """Open a Parquet file; only the part being decoded is kept in memory.

    `as_codes`: columns that are decoded as dictionaries. Raises FormatError if columns have the
    same name, or if the file announces more than its limits.
    """
    import pyarrow.parquet  # takes 0.1 s, which other formats do not need

    budget = Budget.of_file(path, limits)
    stored = pyarrow.parquet.ParquetFile(
        path,
        read_dictionary=sorted(as_codes) or None,
        pre_buffer=False,
        buffer_size=_BUFFER,
        page_checksum_verification=True,
    )
    try:
        _refuse_repeated_names(stored, path)
        _refuse_announced(stored, budget)
        with opened(path) as stream:
            _refuse_pages(stream, stored.metadata, budget)
    except FormatError:
        stored.close()
        raise
    return stored


def _refuse_repeated_names(stored: pyarrow.parquet.ParquetFile, path: Path) -> None:
    """Refuse a file in which several columns have the same name."""
    for name, n in Counter(stored.schema_arrow.names).items():
        if n > 1:
            raise FormatError(
                f"has {n} columns named {name!r}", where=str(path), do="rename one of them"
            )


def _refuse_announced(stored: pyarrow.parquet.ParquetFile, budget: Budget) -> None:
    """Refuse a file that announces more rows, values or bytes than its limits."""
    metadata, clock = stored.metadata, budget.clock()
    budget.refuse_rows(metadata.num_rows)
    budget.refuse_columns(metadata.num_columns)
    budget.refuse_nodes(metadata.num_row_groups, "row groups")
    header = (metadata.metadata or {}).get(b"table_meta_yaml")
    if header is not None:
        refuse_multiplied_yaml(header.decode(), budget)
    values = stated = 0
    for group in map(metadata.row_group, range(metadata.num_row_groups)):
        columns = [group.column(k) for k in range(group.num_columns)]
        values += sum(column.num_values for column in columns)
        stated += sum(column.total_uncompressed_size for column in columns)
        clock()
    budget.refuse_cells(values)
    budget.refuse_content(max(8.0 * values, stated))
    leaves = map(metadata.schema.column, range(metadata.num_columns))
    width = sum(leaf.length for leaf in leaves if leaf.physical_type == "FIXED_LEN_BYTE_ARRAY")
    budget.refuse_content(float(width) * metadata.num_rows)


def _refuse_pages(stream: BinaryIO, metadata: pyarrow.parquet.FileMetaData, budget: Budget) -> None:
    """Refuse pages that hold more than the budget, whatever is announced for their column.

    Arrow makes room for what the header of each page announces.
    """
    clock, total = budget.clock(), 0
    for group in map(metadata.row_group, range(metadata.num_row_groups)):
        for column in map(group.column, range(group.num_columns)):
            starts = [column.data_page_offset, column.dictionary_page_offset or 0]
            at = min(start for start in starts if start > 0)
            end = at + column.total_compressed_size
            while at < end:
                clock()
                sizes, begin = _page_header(stream, at, budget)
                total += sizes[_UNCOMPRESSED]
                budget.refuse_content(total)
                at = begin + sizes[_COMPRESSED]


_UNCOMPRESSED, _COMPRESSED = 2, 3  # fields of PageHeader in parquet.thrift
_MOST_HEADER = 2**24  # bytes of a page header that Arrow reads


def _page_header(stream: BinaryIO, at: int, budget: Budget) -> tuple[dict[int, int], int]:
    """Numbers in the header of a page by their fields, and the place of the byte after it."""
    n = 2**10
    while n <= _MOST_HEADER:
        stream.seek(at)
        raw = stream.read(n)
        try:
            numbers, length = _thrift_struct(raw)
            if min(numbers[_UNCOMPRESSED], numbers[_COMPRESSED]) < 0:
                break
            return numbers, at + length
        except IndexError:  # it goes on, for instance with a long text as the maximum
            if len(raw) < n:
                break
            n *= 2**4
        except (KeyError, ValueError):
            break
    raise FormatError("has a page without a header", where=budget.where, do=DAMAGED)


def _thrift_struct(raw: bytes, at: int = 0, depth: int = 0) -> tuple[dict[int, int], int]:
    """Integers of a struct in Thrift's compact protocol by field, and the offset of its end.

    Raises IndexError if `raw` ends before the struct does, and ValueError if it is not a struct.
    """
    numbers, field = dict[int, int](), 0
    while raw[at]:
        step, kind = divmod(raw[at], 16)
        at += 1
        if step:
            field += step
        else:
            field, at = _thrift_integer(raw, at)
        if kind in (4, 5, 6):  # i16, i32, i64
            numbers[field], at = _thrift_integer(raw, at)
        else:
            at = _after_thrift_value(raw, at, kind, depth)
    return numbers, at + 1


def _thrift_integer(raw: bytes, at: int) -> tuple[int, int]:
    """Signed integer and the offset after it: 7 bits per byte, with the sign in the lowest bit."""
    value, at = _thrift_varint(raw, at)
    return (value >> 1) ^ -(value & 1), at


def _thrift_varint(raw: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        value |= (raw[at] & 127) << shift
        at += 1
        if raw[at - 1] < 128:
            return value, at
    raise ValueError("an integer of more than 64 bits")


def _after_thrift_value(raw: bytes, at: int, kind: int, depth: int) -> int:
    """Offset after a value other than an integer: a boolean, byte, double, string or struct."""
    if kind in (1, 2):  # the kind is the value
        return at
    if kind == 8:
        n, at = _thrift_varint(raw, at)
        at += n
    elif kind == 12 and depth < 4:
        return _thrift_struct(raw, at, depth + 1)[1]
    elif kind in (3, 7):
        at += 1 if kind == 3 else 8
    else:
        raise ValueError("a list or a map, which headers of pages do not have")
    if at > len(raw):
        raise IndexError
    return at


def text_columns(schema: pyarrow.Schema) -> frozenset[str]:
    """Names of the text columns (strings, bytes or dictionaries) of a schema."""
    from pyarrow import types

    kinds = (
        *(types.is_string, types.is_large_string),
        *(types.is_binary, types.is_large_binary, types.is_dictionary),
    )
    return frozenset(column.name for column in schema if any(kind(column.type) for kind in kinds))


def nested_texts(stored: pyarrow.parquet.ParquetFile) -> frozenset[str]:
    """Columns of lists or records with text, which Arrow cannot decode as dictionaries."""
    schema = stored.metadata.schema
    leaves = map(schema.column, range(len(schema)))
    paths = [leaf.path for leaf in leaves if leaf.physical_type == "BYTE_ARRAY"]
    names = stored.schema_arrow.names
    return frozenset(n for n in names if any(path.startswith(f"{n}.") for path in paths))


def refuse_long_text(column: pyarrow.ChunkedArray | pyarrow.Array, budget: Budget) -> None:
    """Raise FormatError for a dictionary column whose text exceeds the limits as a numpy array.

    A single long text in a dictionary may be used in every row without enlarging the file.
    """
    import pyarrow.compute
    from pyarrow import types

    if not types.is_dictionary(column.type):
        return
    kind = column.type.value_type
    if types.is_string(kind) or types.is_large_string(kind) or types.is_binary(kind):
        for chunk in getattr(column, "chunks", [column]):
            lengths = pyarrow.compute.binary_length(chunk.dictionary)
            longest = pyarrow.compute.min_max(lengths)["max"].as_py() or 0
            budget.refuse_content(4.0 * longest * len(column))


def parquet_table(path: Path, limits: FileLimits = LIMITS) -> Table:
    """All rows of a Parquet file as an astropy Table; raises FormatError beyond its limits."""
    import pyarrow.parquet

    budget = Budget.of_file(path, limits)
    texts = text_columns(pyarrow.parquet.read_schema(path))
    with open_parquet(path, texts, limits) as stored:
        units = parquet_units(stored.schema_arrow)
        table = Table(meta=parquet_header(stored.schema_arrow))
        rows = _counted(stored, budget) if nested_texts(stored) else stored.read()
        for name, column in zip(stored.schema_arrow.names, rows.columns, strict=True):
            refuse_long_text(column, budget)
            table[name] = parquet_column(column, units.get(name))
    return table


def _counted(stored: pyarrow.parquet.ParquetFile, budget: Budget) -> pyarrow.Table:
    """All rows, read few at a time so that they can be held against the budget."""
    import pyarrow

    batches, total = list[pyarrow.RecordBatch](), 0
    for batch in stored.iter_batches(1000):
        total += batch.nbytes
        budget.refuse_content(total)
        batches.append(batch)
    return pyarrow.Table.from_batches(batches, stored.schema_arrow if not batches else None)


def arrow_table(data: Any) -> Table:
    """Rows of an object with an Arrow stream (`__arrow_c_stream__`) as an astropy Table.

    Null values are masked; units are read from the metadata of the fields.
    """
    import pyarrow

    rows = pyarrow.RecordBatchReader.from_stream(data).read_all()
    units = parquet_units(rows.schema)
    names = rows.column_names
    return Table(
        [
            parquet_column(column, units.get(n))
            for n, column in zip(names, rows.columns, strict=True)
        ],
        names=names,
        meta=parquet_header(rows.schema),
    )


def parquet_column(values: pyarrow.ChunkedArray, unit: str | None) -> Column:
    """Convert a column of Arrow data to a column of an astropy Table; null values are masked."""
    array = values.combine_chunks()
    if not array.null_count:
        return Column(numpy_array(array), unit=unit)
    import pyarrow

    mask = numpy_array(array.is_null().cast(pyarrow.uint8())).astype(bool)
    return MaskedColumn(numpy_array(array), mask=mask, unit=unit)


def numpy_array(values: pyarrow.Array) -> NDArray[Any]:
    """Values (N,) of an Arrow array; null entries are arbitrary, and numbers are a read-only view.

    It is used because the conversion by Arrow imports pandas, which takes longer than reading a
    small table.
    """
    import pyarrow
    from pyarrow import types

    kind = values.type
    if types.is_floating(kind) or types.is_integer(kind):
        if values.null_count:  # use the numbers without the validity bitmap
            held = [None, values.buffers()[1]]
            values = pyarrow.Array.from_buffers(kind, len(values), held, offset=values.offset)
        return np.from_dlpack(values)
    if types.is_timestamp(kind):
        return numpy_array(values.view(pyarrow.int64())).view(f"M8[{kind.unit}]")
    if types.is_date32(kind):
        return numpy_array(values.view(pyarrow.int32())).astype("M8[D]")
    if types.is_boolean(kind):
        return numpy_array(values.cast(pyarrow.uint8())).astype(bool)
    if types.is_dictionary(kind):
        labels, codes = numpy_array(values.dictionary), numpy_array(values.indices)
        if not len(labels):
            return np.full(len(codes), None)
        return labels.take(codes.astype(np.int64), mode="clip")  # codes of nulls are arbitrary
    if types.is_string(kind) or types.is_large_string(kind) or _is_string_view(kind):
        return np.array(values.to_pylist(), object)
    return values.to_numpy(zero_copy_only=False)


def _is_string_view(kind: pyarrow.DataType) -> bool:
    """True for the string type of polars, which older versions of pyarrow do not have."""
    return str(kind) == "string_view"


def arrow_array(values: NDArray[Any]) -> pyarrow.Array:
    """Convert values (N,) to an Arrow array, a view for numbers; does not import pandas."""
    import pyarrow

    plain = type(values) is np.ndarray and values.ndim == 1 and values.dtype.isnative
    if plain and values.dtype.kind in "iuf":
        held = pyarrow.py_buffer(np.ascontiguousarray(values))
        kind = pyarrow.from_numpy_dtype(values.dtype)
        return pyarrow.Array.from_buffers(kind, len(values), [None, held])
    if plain and values.dtype.kind == "U":
        texts = [str(value).encode() for value in values]
        ends = np.cumsum([0, *map(len, texts)], dtype=np.int32)
        held = [None, pyarrow.py_buffer(ends), pyarrow.py_buffer(b"".join(texts))]
        return pyarrow.Array.from_buffers(pyarrow.string(), len(values), held)
    return pyarrow.array(values)


def parquet_header(schema: pyarrow.Schema) -> dict[str, Any]:
    """Header of a table: the one stored by astropy, or the entry `HEADER` of the metadata."""
    metadata = schema.metadata or {}
    if b"table_meta_yaml" in metadata:
        text = metadata[b"table_meta_yaml"].decode()
        return dict(get_header_from_yaml(text.splitlines()).get("meta") or {})
    try:
        stated = json.loads(metadata.get(HEADER.encode(), b"null"))
    except ValueError:  # an entry of another program
        return {}
    return {HEADER: stated} if isinstance(stated, Mapping) else {}


def parquet_units(schema: pyarrow.Schema) -> dict[str, str]:
    """Units by column name, from the metadata of the fields or the header stored by astropy."""
    units: dict[str, str] = {}
    header = (schema.metadata or {}).get(b"table_meta_yaml")
    if header is not None:
        described = get_header_from_yaml(header.decode().splitlines())["datatype"]
        units = {column["name"]: str(column["unit"]) for column in described if column.get("unit")}
    for schema_field in schema:
        if schema_field.metadata and b"unit" in schema_field.metadata:
            units[schema_field.name] = schema_field.metadata[b"unit"].decode()
    return units
