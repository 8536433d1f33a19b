"""Columns to Arrow and back: without pandas where they are plain, and by Arrow where not."""

from __future__ import annotations

import numpy as np
import pyarrow
import pytest

from bayesdist.files.parquet import arrow_array, numpy_array

COLUMNS = {
    "numbers": np.array([1.5, np.nan, -0.0]),
    "none": np.zeros(0),
    "single": np.arange(4, dtype=np.float32),
    "unsigned": np.array([0, 255], np.uint8),
    "every other one": np.arange(10)[::2],
    "texts": np.array(["a", "", "µ Cas"]),
    "no texts": np.zeros(0, "U3"),
    "flags": np.array([True, False]),
}


@pytest.mark.parametrize("name", COLUMNS)
def test_a_column_comes_back(name):
    values = COLUMNS[name]
    stored = arrow_array(values)
    assert stored.equals(pyarrow.array(values)) or np.isnan(values).any()
    back = numpy_array(stored)
    np.testing.assert_array_equal(back, values)
    assert back.dtype == (object if values.dtype.kind == "U" else values.dtype)


def test_what_is_not_plain_is_left_to_arrow():
    with pytest.raises(pyarrow.ArrowException, match=r"[Bb]yte-swapped"):
        arrow_array(np.arange(3, dtype=">f8"))
    with pytest.raises(pyarrow.ArrowException, match="1-dimensional"):
        arrow_array(np.zeros((2, 2)))
    masked = np.ma.masked_array([1.0, 2.0], [False, True])
    assert arrow_array(masked).to_pylist() == [1.0, None]
