"""The same stars as any object: file, astropy, pandas, polars, Arrow, DuckDB, mapping, records."""

from __future__ import annotations

import datetime

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import Galactic, SkyCoord
from astropy.table import QTable, Table
from astropy.time import Time

from bayesdist.data import Matches, read_matches
from bayesdist.data.columns import COLUMNS
from bayesdist.data.reading.options import ReadOptions
from bayesdist.data.reading.table import match_arguments
from bayesdist.errors import InputError

pandas = pytest.importorskip("pandas")
polars = pytest.importorskip("polars")
pyarrow = pytest.importorskip("pyarrow")

N = 40
UNIT = {"unit": "arcsec"}


def columns(seed=3):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(1, 1000, (2, N))
    return {
        "x": x,
        "y": y,
        "u": 0.1 * x + rng.normal(size=N),
        "v": 0.1 * y,
        "sigma_u": rng.uniform(0.01, 0.02, N),
        "sigma_v": rng.uniform(0.01, 0.02, N),
        "mag": rng.uniform(15, 20, N),
        "exposure": np.array(["first", "second"])[np.arange(N) % 2],
        "chip": 1 + np.arange(N) % 3 // 2,
        "star": rng.permutation(10**17 + np.arange(N)),
        "epoch": np.where(np.arange(N) % 2, 2016.25, 2019.5),
    }


def records(stars):
    kinds = [(name, values.dtype) for name, values in stars.items()]
    out = np.empty(N, kinds)
    for name, values in stars.items():
        out[name] = values
    return out


def in_duckdb(stars):
    duckdb = pytest.importorskip("duckdb")
    rows = pyarrow.table({name: pyarrow.array(values) for name, values in stars.items()})
    return duckdb.from_arrow(rows)  # of the default connection, which stays open


OBJECTS = {
    "Table": Table,
    "QTable": lambda stars: QTable(stars, units={"u": u.arcsec, "v": u.arcsec, "x": u.pix}),
    "pandas": pandas.DataFrame,
    "pandas with Arrow columns": lambda stars: pandas.DataFrame(stars).convert_dtypes(
        dtype_backend="pyarrow"
    ),
    "polars": polars.DataFrame,
    "polars with categories": lambda stars: polars.DataFrame(stars).with_columns(
        polars.col("exposure").cast(polars.Categorical)
    ),
    "pyarrow": lambda stars: pyarrow.table({k: pyarrow.array(v) for k, v in stars.items()}),
    "duckdb": in_duckdb,
    "mapping": dict,
    "lists": lambda stars: {name: values.tolist() for name, values in stars.items()},
    "records": records,
}


def assert_equal(one, other):
    for name in COLUMNS:
        assert one.has(name) == other.has(name), name
        if one.has(name) and name not in ("source",):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
    for name in ("unit", "exposure_names", "chip_numbers", "filter_names", "rejected", "n_rows"):
        assert getattr(one, name) == getattr(other, name), name


@pytest.mark.parametrize("kind", OBJECTS)
def test_the_same_stars_as_any_object(kind, tmp_path):
    stars = columns()
    Table(stars).write(tmp_path / "stars.ecsv")
    from_file = read_matches(tmp_path / "stars.ecsv", **UNIT)
    assert_equal(Matches.from_table(OBJECTS[kind](stars), **UNIT), from_file)
    assert_equal(read_matches(OBJECTS[kind](stars), **UNIT), from_file)


@pytest.mark.parametrize("kind", ["pandas", "polars", "pyarrow", "lists"])
def test_a_missing_value_leaves_the_row_out(kind):
    stars = columns()
    whole = Matches.from_table(stars, **UNIT)
    gaps = {name: values.tolist() for name, values in stars.items()}
    gaps["u"][4] = None
    gaps["exposure"][7] = None
    gaps["star"][9] = None
    maker = {
        "pandas": lambda g: pandas.DataFrame(g | {"star": pandas.array(g["star"], dtype="Int64")}),
        "polars": polars.DataFrame,
        "pyarrow": pyarrow.table,
        "lists": dict,
    }[kind]
    matches = Matches.from_table(maker(gaps), **UNIT)
    assert sum(matches.rejected.values()) == 3 and matches.n_rows == N
    stay = np.setdiff1d(np.arange(N), [4, 7, 9])
    assert (matches.row == stay).all()
    assert (matches.u == whole.u[stay]).all() and (matches.star == whole.star[stay]).all()


def test_dates_of_any_kind_are_one_epoch():
    days = [datetime.datetime(2016, 3, 1) + datetime.timedelta(days=30 * k) for k in range(N)]
    stars = columns() | {"epoch": days}
    years = Time(days, scale="tt").decimalyear
    for table in (
        pandas.DataFrame(stars),
        polars.DataFrame(stars),
        QTable(stars | {"epoch": Time(days, scale="tt")}),
    ):
        np.testing.assert_allclose(Matches.from_table(table, **UNIT).epoch, years, atol=1e-6)
    frame = polars.DataFrame(stars).with_columns(polars.col("epoch").cast(polars.Date))
    np.testing.assert_allclose(Matches.from_table(frame, **UNIT).epoch, years, atol=1e-6)
    common = columns()
    del common["epoch"]
    for epoch in ("2016-07-01", Time("2016-07-01"), datetime.date(2016, 7, 1), 57570 * u.day):
        at = Matches.from_table(common, **UNIT, epoch=epoch).epoch
        np.testing.assert_allclose(at, Time("2016-07-01").decimalyear, atol=1e-4)


def test_units_of_arrow_fields_are_those_of_the_columns():
    stars = columns()
    fields = [
        pyarrow.field(k, pyarrow.array(v).type, metadata={"unit": "deg"} if k in "uv" else None)
        for k, v in stars.items()
    ]
    table = pyarrow.table(list(map(pyarrow.array, stars.values())), schema=pyarrow.schema(fields))
    assert Matches.from_table(table).unit == "deg"


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ([1, 2, 3], "is a list, which is no table; give an astropy Table"),
        ("stars.csv", "is a str, which is no table; read files with read_matches"),
        (np.zeros((3, 4)), "is a ndarray, which is no table"),
        ({"x": [1.0], "y": [1.0, 2.0]}, "columns do not make a table"),
        ({"x": [1.0], "y": [2.0]}, "no column for 'u', 'v' among x, y"),
        (Table(names=["x", "y", "u", "v"]), "holds no rows"),
    ],
)
def test_what_is_no_table_of_matches_is_refused(wrong, says):
    with pytest.raises(InputError, match=says):
        Matches.from_table(wrong, **UNIT)


def test_errors_have_units():
    stars = columns()
    del stars["sigma_u"], stars["sigma_v"]
    matches = Matches.from_table(stars, **UNIT, sigma=30 * u.mas)
    assert np.allclose(matches.sigma_u, 0.03)
    assert np.allclose(matches.with_errors(1e-5 * u.deg).sigma_v, 0.036)
    with pytest.raises(InputError, match="sigma is given in pix, which cannot be converted to arc"):
        matches.with_errors(1 * u.pix)
    with pytest.raises(InputError, match="holds no errors of the positions"):
        Matches.from_table(stars, **UNIT)


def test_errors_of_centroids_are_named():
    """They become errors of the matches, unless the table has these."""
    at = np.array([[1.0, 2.0, 5.0, 9.0, 4.0], [1.0, 7.0, 2.0, 3.0, 8.0]])
    table = dict(zip("xyuv", [*at, *(2 * at)], strict=True)) | {"mag": np.full(5, 9.0)}
    errors = {"x_err": np.full(5, 0.1), "y_err": np.full(5, 0.1)}
    given = match_arguments(table | errors, ReadOptions(**UNIT))
    assert [note for note in given["notes"] if "errors of the centroids were converted" in note]
    np.testing.assert_allclose(given["sigma_u"], 0.2)
    few = {name: values[:3] for name, values in (table | errors).items()}
    with pytest.raises(InputError, match="3 matches do not determine the size of a pixel"):
        match_arguments(few, ReadOptions(**UNIT))
    known = {"sigma_u": np.full(5, 0.1), "sigma_v": np.full(5, 0.1)}
    for other in (table, table | errors | known):
        notes = match_arguments(other, ReadOptions(**UNIT)).get("notes", ())
        assert not [note for note in notes if "centroids" in note]


def test_options_are_named_as_arguments():
    stars = {"x": [1.0, 2.0], "y": [1.0, np.nan], "u": [1.0, 2.0], "v": [1.0, 2.0]}
    with pytest.raises(InputError, match=r"leave out 1 of 2 with not_finite = \"reject\""):
        Matches.from_table(stars, **UNIT, sigma=0.1)
    assert len(Matches.from_table(stars, **UNIT, sigma=0.1, not_finite="reject")) == 1
    with pytest.raises(InputError, match=r"^epoch: epoch is 'yesterday'"):
        Matches.from_table(stars, **UNIT, sigma=0.1, epoch="yesterday")


# -- sky coordinates ------------------------------------------------------------------------------


def gaia(n=N, seed=5):
    rng = np.random.default_rng(seed)
    sky = SkyCoord(
        ra=(150 + 0.2 * rng.uniform(size=n)) * u.deg,
        dec=(40 + 0.2 * rng.uniform(size=n)) * u.deg,
        pm_ra_cosdec=rng.normal(0, 30, n) * u.mas / u.yr,
        pm_dec=rng.normal(0, 30, n) * u.mas / u.yr,
        obstime=Time(2016.0, format="jyear", scale="tdb"),
    )
    return *rng.uniform(1, 2000, (2, n)), sky


def as_gaia_table(x, y, sky):
    return QTable(
        {
            "x": x,
            "y": y,
            "ra": sky.ra,
            "dec": sky.dec,
            "pmra": sky.pm_ra_cosdec,
            "pmdec": sky.pm_dec,
            "ref_epoch": np.full(len(x), 2016.0),
        }
    )


def test_sky_coordinates_are_moved_as_those_of_a_gaia_table():
    x, y, sky = gaia()
    from_table = Matches.from_table(as_gaia_table(x, y, sky), sigma=0.01, epoch=2024.5)
    matches = Matches.from_sky(
        x, y, sky, sigma=10 * u.mas, epoch=Time(2024.5, format="decimalyear")
    )
    for name in ("x", "y", "u", "v", "sigma_u", "pm_u", "epoch"):
        np.testing.assert_allclose(getattr(matches, name), getattr(from_table, name), rtol=1e-12)
    assert any("were moved to 2024.50 by proper motions" in note for note in matches.notes)
    column = QTable({"x": x, "y": y, "radec": sky})
    by_column = Matches.from_table(column, sigma=0.01, epoch=2024.5)
    np.testing.assert_array_equal(by_column.u, matches.u)
    # astropy moves them as far
    far = SkyCoord(
        sky.ra, sky.dec, distance=np.full(N, 1e3) * u.pc, pm_ra_cosdec=sky.pm_ra_cosdec,
        pm_dec=sky.pm_dec, radial_velocity=np.zeros(N) * u.km / u.s, obstime=sky.obstime,
    )  # fmt: skip
    then = far.apply_space_motion(new_obstime=Time(2024.5, format="jyear", scale="tdb"))
    point = SkyCoord(*matches.tangent_point, unit="deg")
    xi, eta = then.transform_to(point.skyoffset_frame()).cartesian.xyz[1:] / (
        then.transform_to(point.skyoffset_frame()).cartesian.x
    )
    np.testing.assert_allclose(matches.u, np.degrees(xi.value) * 3600, atol=1e-5)
    np.testing.assert_allclose(matches.v, np.degrees(eta.value) * 3600, atol=1e-5)


def test_frames_origins_and_points():
    x, y, sky = gaia()
    still = SkyCoord(sky.ra, sky.dec)
    point = SkyCoord(150.1 * u.deg, 40.1 * u.deg)
    a = Matches.from_sky(x, y, still, sigma=0.01, tangent_point=point)
    b = Matches.from_sky(
        x - 1, y - 1, still.transform_to(Galactic()), sigma=0.01, pixel_origin=0,
        tangent_point=point.galactic,
    )  # fmt: skip
    np.testing.assert_allclose(a.u, b.u, atol=1e-8)
    np.testing.assert_allclose(a.x, b.x, rtol=1e-14)
    assert a.tangent_point == pytest.approx((150.1, 40.1))
    moving = Matches.from_sky(x, y, sky.galactic, sigma=0.01, epoch=2024.5)
    np.testing.assert_allclose(
        moving.u, Matches.from_sky(x, y, sky, sigma=0.01, epoch=2024.5).u, atol=1e-6
    )


def test_columns_beside_sky_coordinates():
    x, y, sky = gaia()
    more = {
        "mag": np.linspace(15, 20, N),
        "exposure": ["a"] * 20 + ["b"] * 20,
        "chip": [1, 2] * 20,
        "epoch": Time(np.repeat([2020.0, 2021.0], 20), format="decimalyear"),
    }
    sigma = (np.full(N, 10.0) * u.mas, np.full(N, 20.0) * u.mas)
    matches = Matches.from_sky(x, y, sky, sigma=sigma, **more)
    assert matches.exposure_names == ("a", "b") and matches.chip_numbers == (1, 2)
    assert np.allclose(matches.sigma_u, 0.01) and np.allclose(matches.sigma_v, 0.02)
    np.testing.assert_allclose(matches.epoch, np.repeat([2020.0, 2021.0], 20), atol=1e-4)
    assert not Matches.from_sky(x, y, sky, mag=more["mag"]).has_sigma


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"sky": 3}, "sky: is a int, not sky coordinates; give a SkyCoord"),
        ({"x": np.ones(3)}, r"y: has the shape \(40,\), and x has 3 values; give one value for"),
        ({"sigma": 1 * u.pix}, "unit pix cannot be converted to arcsec"),
        ({"tangent_point": (1 * u.pix, 2.0)}, "tangent_point is given in pix"),
        ({"epoch": "yesterday"}, "epoch is 'yesterday', which is not a date"),
        ({"epoch": 3.0}, "epoch is 3, which is not a year"),
        ({"sigma": None}, "magnitude"),
        ({"mag": np.ones(3)}, r"mag: has the shape \(3,\), and x has 40 values"),
    ],
)
def test_wrong_sky_coordinates_are_one_sentence(change, says):
    x, y, sky = gaia()
    given = {"x": x, "y": y, "sky": sky, "sigma": 0.01} | change
    with pytest.raises(InputError, match=says):
        Matches.from_sky(given.pop("x"), given.pop("y"), given.pop("sky"), **given)


# -- out ------------------------------------------------------------------------------------------


def full_matches():
    stars = columns() | {"filter": np.where(np.arange(N) % 2, "F606W", "F814W")}
    stars |= {"colour": np.linspace(0, 1, N), "u_nominal": stars["u"], "v_nominal": stars["v"]}
    return Matches.from_table(stars, **UNIT)


def test_a_table_of_matches_has_units_and_names_and_comes_back():
    matches = full_matches().with_columns(tangent_point=(30.0, 5.0), match_radius=0.5)
    table = matches.to_table()
    assert table["u"].unit == u.arcsec and table["x"].unit == u.pix
    assert table["sigma_u"].unit == u.arcsec and table["epoch"].unit == u.yr
    assert table["mag"].unit == u.mag
    assert (table["exposure"] == columns()["exposure"]).all()
    assert (table["chip"] == columns()["chip"]).all()
    assert set(table["filter"]) == {"F606W", "F814W"}
    again = Matches.from_table(table)
    assert_equal(again, matches)
    assert again.tangent_point == (30.0, 5.0) and again.match_radius == 0.5


def test_a_table_of_matches_is_written_and_read(tmp_path):
    matches = full_matches().with_columns(tangent_point=(30.0, 5.0))
    matches.to_table().write(tmp_path / "out.ecsv")
    again = read_matches(tmp_path / "out.ecsv")
    assert_equal(again, matches)
    assert again.tangent_point == (30.0, 5.0)


def test_the_radius_is_in_the_unit_of_the_positions():
    matches = full_matches().with_columns(match_radius=0.5)  # arcsec
    table = matches.to_table()
    for name in ("u", "v", "sigma_u", "sigma_v", "u_nominal", "v_nominal"):
        table[name] = table[name].to("mas")
    again = Matches.from_table(table)
    assert again.unit == "mas" and again.match_radius == pytest.approx(500.0)


def test_files_of_matches_keep_tangent_point_and_radius(tmp_path):
    from pyarrow import parquet

    from bayesdist.data import open_matches, write_partitioned

    matches = full_matches().with_columns(tangent_point=(30.0, 5.0), match_radius=0.5)
    matches.to_table().write(tmp_path / "astropy.parquet")
    parquet.write_table(pyarrow.table(matches), tmp_path / "arrow.parquet")
    write_partitioned([matches], tmp_path / "parts")
    for place in ("astropy.parquet", "arrow.parquet", "parts"):
        for read in (read_matches, open_matches):
            again = read(tmp_path / place)
            assert again.tangent_point == (30.0, 5.0) and again.match_radius == 0.5
    other = matches.with_columns(match_radius=0.25, x=matches.x + 0.5)
    write_partitioned([matches, other], tmp_path / "differing")
    for read in (read_matches, open_matches):
        with pytest.raises(InputError, match="match radii differ"):
            read(tmp_path / "differing")


def test_matches_are_an_arrow_stream():
    matches = full_matches()
    table = pyarrow.table(matches)
    assert table.num_rows == N
    assert table.schema.field("u").metadata == {b"unit": b"arcsec"}
    assert table["exposure"].to_pylist() == columns()["exposure"].tolist()
    frame = polars.DataFrame(matches)
    assert frame.height == N and frame["exposure"].to_list() == columns()["exposure"].tolist()
    np.testing.assert_array_equal(frame["u"].to_numpy(), matches.u)
    np.testing.assert_array_equal(polars.from_arrow(table)["chip"], columns()["chip"])
    assert_equal(Matches.from_table(table), matches)
    assert_equal(Matches.from_table(frame, **UNIT), matches)
    assert_equal(Matches.from_table(matches), matches)


def test_matches_on_disk_stream_batch_by_batch(tmp_path):
    from bayesdist.data import open_matches, write_partitioned

    whole = full_matches()
    write_partitioned([whole.select(np.arange(25)), whole.select(np.arange(25, N))], tmp_path / "p")
    opened = open_matches(tmp_path / "p")
    table = pyarrow.table(opened)
    np.testing.assert_array_equal(np.asarray(table["u"]), whole.u)
    assert table["exposure"].to_pylist() == columns()["exposure"].tolist()
    assert len(opened.to_table()) == N


def test_matches_describe_themselves():
    matches = full_matches()
    said = "<40 matches in memory: 2 exposures, 2 chips, u and v in arcsec, median error 0.0"
    assert repr(matches).startswith(said)
    assert "<b>40 matches</b>" in matches._repr_html_()
    assert "no errors" in repr(Matches([1.0], [2.0], [3.0], [4.0]))
    named = Matches([1.0], [2.0], [3.0], [4.0], sources=("<script>",))
    assert "<script>" not in named._repr_html_()
