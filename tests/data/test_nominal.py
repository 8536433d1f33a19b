"""Nominal positions: columns that go wherever the matches go."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.data import Matches, open_matches, read_matches
from bayesdist.data.preparing import HoldoutSpec, split_matches
from bayesdist.data.writing import write_partitioned
from bayesdist.errors import InputError

NOMINAL = ("u_nominal", "v_nominal")


@pytest.fixture
def stars(rng):
    n = 60
    x, y, u, v = rng.uniform(1, 2048, (4, n))
    t = Table({"x": x, "y": y, "u": u, "v": v, "su": np.full(n, 0.02), "sv": np.full(n, 0.02)})
    t["u_nominal"], t["v_nominal"] = u + rng.normal(size=n), v + rng.normal(size=n)
    for name in ("u", "v"):
        t[name].unit = "arcsec"
    return t


def test_every_format(stars, tmp_path):
    for suffix in ("ecsv", "fits", "csv", "parquet"):
        path = tmp_path / f"stars.{suffix}"
        stars.write(path)
        table = read_matches(path, unit="arcsec")
        assert table.has_nominal
        for name in NOMINAL:
            assert getattr(table, name) == pytest.approx(np.asarray(stars[name]), rel=1e-15)


def test_named_converted_and_left_out(stars, tmp_path):
    stars["un"], stars["vn"] = 1e3 * stars["u_nominal"], 1e3 * stars["v_nominal"]
    stars["un"].unit = stars["vn"].unit = "mas"
    path = tmp_path / "stars.ecsv"
    stars.write(path)
    table = read_matches(path, columns={"u_nominal": "un", "v_nominal": "vn"})
    assert table.u_nominal == pytest.approx(np.asarray(stars["u_nominal"]))
    assert table.v_nominal == pytest.approx(np.asarray(stars["v_nominal"]))
    bare = read_matches(path, columns={"u_nominal": "", "v_nominal": ""})
    assert bare.u_nominal is None and not bare.has_nominal


def test_on_disk_as_in_memory(stars, tmp_path):
    table = Matches(
        **{name: np.asarray(stars[name]) for name in ("x", "y", "u", "v", *NOMINAL)},
        sigma_u=np.full(60, 0.02),
        sigma_v=np.full(60, 0.02),
    )
    folder = tmp_path / "parts"
    write_partitioned([table.select(np.arange(60) < 35), table.select(np.arange(60) >= 35)], folder)
    found = open_matches(folder)
    assert found.has_nominal
    for name in NOMINAL:
        expected = getattr(table, name)
        assert np.array_equal(
            np.concatenate([getattr(p.load(), name) for p in found.readers()]), expected
        )
        assert np.array_equal(getattr(found.sample(10), name), expected[::6])
        assert np.array_equal(
            getattr(found.with_errors((0.1, 0.1)).sample(10), name), expected[::6]
        )
        assert np.array_equal(getattr(read_matches(folder), name), expected)


def test_kept_by_all_that_makes_tables(stars):
    table = Matches(**{name: np.asarray(stars[name]) for name in ("x", "y", "u", "v", *NOMINAL)})
    both = Matches.concatenate([table.select([0, 1]), table.select([5])])
    assert np.array_equal(both.u_nominal, table.u_nominal[[0, 1, 5]])
    assert np.array_equal(table.sample(20).v_nominal, table.v_nominal[::3])
    assert np.array_equal(table.with_errors((0.1, 0.1)).u_nominal, table.u_nominal)
    assert np.array_equal(table.readers()[0].load().v_nominal, table.v_nominal)
    split = split_matches(table, HoldoutSpec(0.3))
    held = HoldoutSpec(0.3).which(table)
    assert np.array_equal(split.held.u_nominal, table.u_nominal[held])
    assert np.array_equal(split.kept.u_nominal, table.u_nominal[~held])
    bare = Matches(*(np.asarray(stars[name]) + 1 for name in ("x", "y", "u", "v")))
    with pytest.raises(InputError, match="has no 'u_nominal'"):
        Matches.concatenate([table, bare])


def test_wrong_input(stars, tmp_path):
    alone = stars.copy()
    alone.remove_column("v_nominal")
    for suffix in ("ecsv", "parquet"):
        path = tmp_path / f"alone.{suffix}"
        alone.write(path)
        read = read_matches if suffix == "ecsv" else open_matches
        with pytest.raises(InputError) as error:
            read(path, unit="arcsec")
        assert "column 'v_nominal' is given without its partner; give nominal positions" in str(
            error.value
        )
    with pytest.raises(InputError, match="column 'u_nominal' is given without its partner"):
        Matches([1.0], [1.0], [1.0], [1.0], v_nominal=[1.0])
    stars["v_nominal"][4] = np.nan
    stars.write(tmp_path / "nan.ecsv")
    with pytest.raises(InputError, match="row 5, column 'v_nominal': value is"):
        read_matches(tmp_path / "nan.ecsv")
    stars["v_nominal"] = 1.0
    stars["v_nominal"].unit = "s"
    stars.write(tmp_path / "unit.ecsv")
    with pytest.raises(InputError, match="column 'v_nominal'"):
        read_matches(tmp_path / "unit.ecsv")


def test_on_the_sky_the_plane_must_be_known(stars, tmp_path):
    """The mean direction of the stars that were matched would be another plane."""
    stars["ra"], stars["dec"] = stars["u"] / 3600 + 10.0, stars["v"] / 3600
    stars.remove_columns(["u", "v"])
    path = tmp_path / "sky.ecsv"
    stars.write(path)
    with pytest.raises(
        InputError, match=r"set data\.tangent_point to that of the nominal positions"
    ):
        read_matches(path)
    table = read_matches(path, tangent_point=(10.0, 0.0))
    assert table.unit == "arcsec" and table.has_nominal
