from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.data import (
    Matches,
    ReferenceCatalog,
    match_table,
    open_matches,
    read_matches,
    write_partitioned,
)
from bayesdist.errors import InputError

BIG = 6_123_456_789_012_345_679  # beyond the whole numbers of float64


def table(n=6, **changes):
    k = np.arange(n, dtype=float)
    columns = {"x": 10 + k, "y": 20 + k, "u": 0.5 * k, "v": -k, "star": BIG + np.arange(n)}
    return Matches(**{**columns, **changes})


def test_codes_follow_their_stars():
    t = table()
    assert t.select([4, 1]).star.tolist() == [BIG + 4, BIG + 1]
    assert t.with_errors(1.0).star.tolist() == t.star.tolist()
    assert t.readers()[0].load().star.tolist() == t.star.tolist()
    assert replace(t, star=None).star is None and table(star=None).select([0]).star is None


def test_joined_tables_have_codes_when_all_have_them():
    a, b = table(exposure_names=("a",)), table(exposure_names=("b",))
    assert Matches.concatenate([a, b]).star.tolist() == [*a.star, *b.star]
    assert Matches.concatenate([a, replace(b, star=None)]).star is None


def test_codes_are_not_negative():
    with pytest.raises(InputError, match="row 3, column 'star': value is -1"):
        table(star=[0, 1, -1, 2, 3, 4])


@pytest.mark.parametrize("suffix", [".ecsv", ".fits", ".csv", ".parquet"])
def test_a_column_of_a_file(tmp_path, suffix):
    path = tmp_path / f"m{suffix}"
    t = table()
    columns = Table({name: getattr(t, name) for name in ("x", "y", "u", "v", "star")})
    if suffix == ".parquet":
        write_partitioned([t], tmp_path / "folder")
        path = tmp_path / "folder"
    else:
        columns.write(path)
    assert read_matches(path, unit=None if suffix == ".parquet" else "pix",
                        sigma=1.0).star.tolist() == t.star.tolist()  # fmt: skip


def test_names_are_no_codes(tmp_path):
    Table({"x": [1.0], "y": [1.0], "u": [1.0], "v": [1.0], "star": ["HD 1"]}).write(
        tmp_path / "m.csv"
    )
    with pytest.raises(InputError, match="row 1, column 'star': 'HD 1' is not a number"):
        read_matches(tmp_path / "m.csv", unit="pix", sigma=1.0)
    without = read_matches(tmp_path / "m.csv", columns={"star": ""}, unit="pix", sigma=1.0)
    assert without.star is None


def test_parts_on_disk_carry_codes(tmp_path):
    tables = [table(exposure_names=(name,)) for name in "abc"]
    write_partitioned(tables, tmp_path / "parts", rows_per_group=4)
    opened = open_matches(tmp_path / "parts", sigma=1.0)
    read = [piece.load() for piece in opened.readers()]
    assert np.concatenate([one.star for one in read]).tolist() == 3 * tables[0].star.tolist()
    assert opened.sample(6).star is not None
    with pytest.raises(InputError, match="other columns"):
        write_partitioned([tables[0], replace(tables[1], star=None)], tmp_path / "mixed")


def test_matching_names_the_star(rng):
    uv = rng.uniform(0, 400, (2, 200))
    catalog = ReferenceCatalog(u=uv[0], v=uv[1], star=BIG + rng.permutation(200))
    seen = uv[:, ::-1] + 3.0
    t = match_table(Matches(*seen, *seen), catalog)
    np.testing.assert_array_equal(t.star, catalog.star[199 - t.row])
