"""Damage to Parquet and HDF5 files."""

from __future__ import annotations

import io

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from hypothesis import strategies as st

from tests.fuzz.mutation import KNOWABLE, OPEN, changes

ANY = st.integers(0, 60)
NUMBERS = st.sampled_from([float("nan"), float("inf"), 0.0, -1.0, 1e300])


def _parquet(content: bytes) -> pa.Table:
    return pq.read_table(io.BytesIO(content))


def _as_parquet(table: pa.Table) -> bytes:
    out = io.BytesIO()
    pq.write_table(table, out)
    return out.getvalue()


def _column(**more):
    return lambda content: st.fixed_dictionaries({"column": ANY, **more})


@changes("lost fields", OPEN, "parquet", arguments=_column())
def field_lost(content, column):
    table = _parquet(content)
    return _as_parquet(table.remove_column(column % table.num_columns))


@changes("doubled rows", KNOWABLE, "parquet", arguments=_column())
def fields_of_one_name(content, column):
    """The column after one has its name."""
    table = _parquet(content)
    one = column % table.num_columns
    names = list(table.column_names)
    names[(one + 1) % len(names)] = names[one]
    return _as_parquet(table.rename_columns(names))


@changes(
    "wrong types",
    OPEN,
    "parquet",
    arguments=_column(kind=st.sampled_from(["text", "list", "null", "bool", "struct", "time"])),
)
def field_of_another_type(content, column, kind):
    table = _parquet(content)
    one = column % table.num_columns
    n = table.num_rows
    new = {
        "text": lambda: pa.array([f"{k}" for k in range(n)]),
        "list": lambda: pa.array([[1.0, 2.0]] * n),
        "null": lambda: pa.nulls(n),
        "bool": lambda: pa.array([True] * n),
        "struct": lambda: pa.array([{"a": 1.0}] * n),
        "time": lambda: pa.array([0] * n, pa.timestamp("ns")),
    }[kind]()
    return _as_parquet(table.set_column(one, table.column_names[one], new))


@changes(
    "no number",
    KNOWABLE,
    "parquet",
    arguments=_column(
        row=st.floats(0, 1), value=st.sampled_from([float("nan"), float("inf"), None])
    ),
)
def value_not_finite(content, column, row, value):
    table = _parquet(content)
    floats = [k for k, f in enumerate(table.schema) if pa.types.is_floating(f.type)]
    if not floats or not table.num_rows:
        return content
    one = floats[column % len(floats)]
    numbers = table.column(one).to_pylist()
    numbers[int(row * (len(numbers) - 1))] = value
    field = table.schema.field(one).with_nullable(True)
    return _as_parquet(table.set_column(one, field, pa.array(numbers, field.type)))


@changes("odd numbers", OPEN, "parquet", arguments=_column(value=NUMBERS))
def field_is(content, column, value):
    table = _parquet(content)
    floats = [k for k, f in enumerate(table.schema) if pa.types.is_floating(f.type)]
    if not floats:
        return content
    one = floats[column % len(floats)]
    field = table.schema.field(one)
    new = pa.array(np.full(table.num_rows, value)).cast(field.type)
    return _as_parquet(table.set_column(one, field, new))


@changes("lost fields", KNOWABLE, "parquet")
def no_rows(content):
    return _as_parquet(_parquet(content)[:0])


# -- HDF5 -----------------------------------------------------------------------------------------


def _edited(content: bytes, change) -> bytes:
    out = io.BytesIO(content)
    with h5py.File(out, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        if names:
            change(file, names)
    return out.getvalue()


def _item(**more):
    return lambda content: st.fixed_dictionaries({"item": ANY, **more})


@changes("lost fields", KNOWABLE, "hdf5", arguments=_item())
def variable_lost(content, item):
    def change(file, names):
        del file[names[item % len(names)]]

    return _edited(content, change)


@changes(
    "wrong types",
    KNOWABLE,
    "hdf5",
    arguments=_item(
        kind=st.sampled_from(["shape", "text", "empty", "group", "nan", "inf", "zero"])
    ),
)
def variable_is(content, item, kind):
    def change(file, names):
        name = names[item % len(names)]
        old = file[name]
        shape = old.shape if isinstance(old, h5py.Dataset) else (2,)
        is_number = isinstance(old, h5py.Dataset) and old.dtype.kind in "fi"
        if kind in ("nan", "inf", "zero"):
            if is_number and old.dtype.kind == "f":
                old[...] = {"nan": np.nan, "inf": np.inf, "zero": 0.0}[kind]
            return
        del file[name]
        if kind == "shape":
            file[name] = np.zeros((*shape, 2))
        elif kind == "text":
            file[name] = "abc"
        elif kind == "empty":
            file[name] = np.zeros(0)
        else:
            file.create_group(name)

    return _edited(content, change)


@changes(
    "wrong types",
    KNOWABLE,
    "hdf5",
    arguments=_item(
        attribute=ANY, value=st.sampled_from([None, 0, -1, "", "abc", "{}", "[", 1e300, [1, 2]])
    ),
)
def attribute_is(content, item, attribute, value):
    def change(file, names):
        places = [file, *(file[name] for name in names)]
        places = [one for one in places if len(one.attrs)]
        if not places:
            return
        one = places[item % len(places)]
        name = list(one.attrs)[attribute % len(one.attrs)]
        if name in ("DIMENSION_LIST", "REFERENCE_LIST"):
            return
        if value is None:
            del one.attrs[name]
        else:
            one.attrs[name] = value

    return _edited(content, change)
