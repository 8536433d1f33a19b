from __future__ import annotations

from functools import partial

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.wcs.utils import fit_wcs_from_points

from bayesdist.data import Matches, input_files, open_matches, read_matches
from bayesdist.data.formats import write_matches
from bayesdist.errors import FormatError, InputError


@pytest.fixture
def stars(rng):
    n = 30
    x, y = rng.uniform(1, 2048, (2, n))
    t = Table(
        {"x": x, "y": y, "u": 0.05 * x, "v": 0.05 * y, "su": np.full(n, 2.0), "sv": np.full(n, 2.0)}
    )
    t["exp"] = np.repeat(["second", "first"], n // 2)
    for name, unit in {
        "x": "pix",
        "y": "pix",
        "u": "arcsec",
        "v": "arcsec",
        "su": "mas",
        "sv": "mas",
    }.items():
        t[name].unit = unit
    return t


@pytest.mark.parametrize("suffix", ["ecsv", "fits", "parquet", "fits.gz"])
def test_every_format_brings_the_same_table(stars, tmp_path, suffix):
    path = tmp_path / f"stars.{suffix}"
    stars.write(path)
    t = read_matches(path)
    for name in "xyuv":
        assert (getattr(t, name) == stars[name]).all()
    assert t.unit == "arcsec" and t.sigma_u == pytest.approx(0.002)
    assert t.exposure_names == ("second", "first") and t.sources == (str(path),)


def test_csv_needs_its_unit(stars, tmp_path):
    path = tmp_path / "stars.csv"
    stars.write(path, format="ascii.csv")
    path.write_text("# a comment\n" + path.read_text())
    with pytest.raises(InputError, match="has no unit"):
        read_matches(path)
    t = read_matches(path, unit="arcsec", sigma=0.002)
    assert (t.x == stars["x"]).all() and t.sigma_v == pytest.approx(0.002)


def test_a_field_of_metadata_carries_a_parquet_unit(stars, tmp_path):
    fields = [
        pa.field(n, pa.float64(), metadata={"unit": "mas"} if n in "uv" else None) for n in "xyuv"
    ]
    columns = [np.asarray(stars[n]) for n in "xyuv"]
    pq.write_table(pa.table(columns, schema=pa.schema(fields)), tmp_path / "a.parquet")
    assert read_matches(tmp_path / "a.parquet", sigma=1).unit == "mas"


def test_nulls_are_missing_values(tmp_path):
    columns = {n: [1.0, None, 3.0] if n == "v" else [1.0, 2.0, 3.0] for n in "xyuv"}
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    found = read_matches(tmp_path / "a.parquet", unit="pix", sigma=1)
    assert found.rejected == {"no value in column 'v'": 1} and found.row.tolist() == [0, 2]
    with pytest.raises(InputError, match="row 2, column 'v': value is missing"):
        open_matches(tmp_path / "a.parquet", unit="pix", sigma=1)  # nothing is left out on disk


def test_nan_in_fits_is_nan(stars, tmp_path):
    stars["u"][6] = np.nan
    stars.write(tmp_path / "a.fits")
    with pytest.raises(InputError, match=r"a\.fits, row 7, column 'u': value is nan"):
        read_matches(tmp_path / "a.fits")


def test_several_files_are_several_exposures(stars, tmp_path):
    stars.remove_column("exp")
    for k, name in enumerate(("b.ecsv", "a.ecsv", "c.ecsv")):
        stars[10 * k : 10 * k + 10].write(tmp_path / name)
    t = read_matches(str(tmp_path / "*.ecsv"))
    assert t.exposure_names == ("a", "b", "c") and (np.bincount(t.exposure) == 10).all()
    assert (t.x[:10] == stars["x"][10:20]).all() and t.row[10] == 0
    # in the order of a list, and the exposure of one file alone needs no name
    assert read_matches([tmp_path / n for n in ("b.ecsv", "a.ecsv")]).exposure_names == ("b", "a")
    assert read_matches(tmp_path / "b.ecsv").exposure_names == ("1",)


def test_files_of_one_name_are_told_apart_by_their_folders(stars, tmp_path):
    stars.remove_column("exp")
    for k, night in enumerate(("n1", "n2")):
        (tmp_path / night).mkdir()
        stars[15 * k : 15 * k + 15].write(tmp_path / night / "stars.ecsv")
    assert read_matches(str(tmp_path / "*/stars.ecsv")).exposure_names == ("n1/stars", "n2/stars")


def test_a_folder_of_parquet_is_one_table(stars, tmp_path):
    stars.remove_column("exp")
    (tmp_path / "all").mkdir()
    for k in range(3):
        stars[10 * k : 10 * k + 10].write(tmp_path / "all" / f"part-{k}.parquet")
    t = read_matches(tmp_path / "all")
    assert (t.x == stars["x"]).all() and t.exposure_names == ("1",)
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match="folder without Parquet"):
        read_matches(tmp_path / "none")


def test_where_errors_come_from(stars, tmp_path):
    path = tmp_path / "stars.ecsv"
    stars.write(path)
    with pytest.raises(InputError, match="no magnitudes"):
        read_matches(path, sigma="by_magnitude")
    stars["mag"] = np.arange(30.0)
    stars["su"][3] = -1.0  # of no matter when errors do not come from columns
    stars.write(path, overwrite=True)
    assert read_matches(path, sigma="by_magnitude").sigma_u is None
    assert (read_matches(path, sigma=0.5).sigma_u == 0.5).all()
    with pytest.raises(InputError, match=r"row 4, column 'su': sigma is -0\.001"):
        read_matches(path)
    stars.remove_columns(["su", "sv"])
    stars.write(path, overwrite=True)
    with pytest.raises(InputError, match="no errors of the positions"):
        read_matches(path)
    for bad in ("column", 0.0, -1, np.nan, True):
        with pytest.raises(InputError, match="sigma is"):
            read_matches(path, sigma=bad)


def test_what_is_wrong_with_paths_and_formats(stars, tmp_path):
    with pytest.raises(InputError, match=r"none\.fits: does not exist"):
        read_matches(tmp_path / "none.fits")
    with pytest.raises(InputError, match="no file matches the pattern"):
        read_matches(str(tmp_path / "*.fits"))
    with pytest.raises(InputError, match="no file is named"):
        read_matches([])
    stars.write(tmp_path / "a.ecsv")
    with pytest.raises(InputError, match="is named twice"):
        read_matches([tmp_path / "a.ecsv", str(tmp_path / "*.ecsv")])
    with pytest.raises(InputError, match="format is 'rvb'"):
        read_matches(tmp_path / "a.ecsv", format="rvb")
    (tmp_path / "a.txt").write_text("1 2 3\n")
    with pytest.raises(FormatError, match="of an unknown kind"):
        read_matches(tmp_path / "a.txt")
    with pytest.raises(InputError, match=r"extension '\.txt'"):
        read_matches(tmp_path / "a.txt", format="table")
    fits.PrimaryHDU(np.ones((4, 4))).writeto(tmp_path / "image.fits")
    with pytest.raises(FormatError, match="no table extension"):
        read_matches(tmp_path / "image.fits")
    stars[:0].write(tmp_path / "empty.fits")
    with pytest.raises(InputError, match=r"empty\.fits: holds no rows"):
        read_matches(tmp_path / "empty.fits")
    (tmp_path / "wrong.fits").write_text("this is no FITS file\n")
    with pytest.raises(FormatError, match=r"wrong\.fits"):
        read_matches(tmp_path / "wrong.fits")


def test_a_repeated_row_is_found_across_the_columns(stars, tmp_path):
    stars["exp"] = "one"
    stars.add_row(stars[4])
    stars.write(tmp_path / "a.ecsv")
    with pytest.raises(InputError, match=r"row 31: repeats .*a\.ecsv, row 5"):
        read_matches(tmp_path / "a.ecsv")


@pytest.mark.parametrize("name", ["Harry695_corr.fits", "AstroTomii_corr.fits"])
def test_astrometry_net_positions_make_a_sensible_plate(data_dir, name):
    path = data_dir / "anet_pairs" / name
    t = read_matches(path, sigma=1.0)
    raw = Table(fits.getdata(path))
    assert len(t) == len(raw) and t.unit == "arcsec"
    # field_x are FITS pixels: astropy's own fit of a linear TAN header in that convention
    wcs = fit_wcs_from_points(
        (t.x - 1, t.y - 1), SkyCoord(raw["index_ra"], raw["index_dec"], unit="deg"),
        proj_point=SkyCoord(*t.tangent_point, unit="deg"),
    )  # fmt: skip
    A = np.column_stack([np.ones(len(t)), t.x, t.y])
    ours = (
        np.column_stack([t.u, t.v])
        - A @ np.linalg.lstsq(A, np.column_stack([t.u, t.v]), rcond=None)[0]
    )
    scale = np.sqrt(abs(np.linalg.det(wcs.pixel_scale_matrix))) * 3600
    # a star's residual is a pixel or two, at the scale that astropy finds
    assert np.median(np.hypot(*ours.T)) < 2.0 * scale
    rows = np.linalg.lstsq(A, np.column_stack([t.u, t.v]), rcond=None)[0][1:]
    assert np.sqrt(abs(np.linalg.det(rows))) == pytest.approx(scale, rel=1e-3)


def test_astrometry_net_has_no_errors_of_its_own(data_dir):
    path = data_dir / "anet_pairs" / "Harry695_corr.fits"
    with pytest.raises(InputError, match="no errors"):
        read_matches(path)
    with pytest.raises(InputError, match="option 'pixel_origin' is given"):
        read_matches(path, sigma=1, pixel_origin=0)
    with pytest.raises(InputError, match="option 'unit' is given"):
        read_matches(path, sigma=1, unit="pix")
    # the origin that the format has may be stated
    assert (read_matches(path, sigma=1, pixel_origin=1).x == read_matches(path, sigma=1).x).all()
    # as any other table, by its columns
    columns = {"x": "field_x", "y": "field_y", "ra": "index_ra", "dec": "index_dec"}
    t = read_matches(path, columns=columns, sigma=1)
    assert (t.u == read_matches(path, sigma=1).u).all()


def test_files_on_the_sky_share_one_plane(rng, tmp_path):
    for k in range(2):
        ra, dec = 10 + 0.1 * k + rng.uniform(-0.05, 0.05, 20), rng.uniform(-0.05, 0.05, 20)
        Table({"x": ra, "y": dec, "ra": ra, "dec": dec}).write(
            tmp_path / f"{k}.csv", format="ascii.csv"
        )
    t = read_matches(str(tmp_path / "*.csv"), sigma=1)
    assert t.tangent_point[0] == pytest.approx(10.05, abs=0.02)
    first, second = (t.u[t.exposure == k].mean() for k in (0, 1))
    assert second - first == pytest.approx(360.0, abs=60.0)  # 0.1 degrees apart


def test_input_files_are_sorted_and_named(tmp_path):
    for name in ("b.csv", "a.csv"):
        (tmp_path / name).write_text("x")
    assert [p.name for p in input_files(str(tmp_path / "?.csv"))] == ["a.csv", "b.csv"]


OPTIONS = {
    "columns": {"mag": ""},
    "unit": "mas",
    "pixel_origin": 0,
    "tangent_point": (10.001, 20.0),
    "epoch": 2030.0,
    "catalogue_epoch": 2000.0,
    "not_finite": "reject",
    "same_position": "separate_stars",
}


def star_table(columns, bad=False):
    k = np.arange(1.0, 9)
    values = {"x": 90 * k, "y": 50 * k + k**2, "u": k, "v": k**2, "ra": 10 + k / 1e3,
              "dec": 20 + k**2 / 1e4, "mag": 12 + k}  # fmt: skip
    for name in ("u", "v", "ra", "dec"):
        values[name][1] = values[name][0]
    if bad:
        values["x"][3] = np.nan
    names = columns if isinstance(columns, dict) else dict.fromkeys(columns)
    table = Table({column or name: values[name] for name, column in names.items()})
    table.meta = {}
    return table


def on_sky(bad=False, **more):
    table = star_table(("x", "y", "ra", "dec", "mag"), bad)
    for name, value in {
        "pmra": 500.0,
        "pmdec": -300.0,
        "parallax": 1.0,
        "ruwe": 1.0,
        **more,
    }.items():
        table[name] = value
    return table


MOVING = {"epoch": 2020.0, "catalogue_epoch": 2016.0}
CORR_NAMES = {"x": "field_x", "y": "field_y", "ra": "index_ra", "dec": "index_dec", "mag": "mag"}
# file, table, options that it needs, and those that are refused
READERS = {
    "plane": ("a.fits", lambda bad: star_table(("x", "y", "u", "v", "mag"), bad),
              {"unit": "arcsec"}, {"tangent_point", "catalogue_epoch"}),
    "sky without motions": ("a.fits", lambda bad: star_table(("x", "y", "ra", "dec", "mag"), bad),
                            {}, {"unit", "catalogue_epoch"}),
    "sky": ("a.fits", on_sky, MOVING, {"unit"}),
    "sky with its epoch": ("a.fits", lambda bad: on_sky(bad, ref_epoch=2016.0), {"epoch": 2020.0},
                           {"unit", "catalogue_epoch"}),
    "named stars": ("a.fits", lambda bad: on_sky(bad, star=np.arange(8)), MOVING,
                    {"unit", "same_position"}),
    "corr.fits": ("corr.fits", lambda bad: star_table(CORR_NAMES, bad), {},
                  {"columns", "unit", "pixel_origin", "epoch", "catalogue_epoch"}),
}  # fmt: skip


@pytest.mark.parametrize("option", OPTIONS)
@pytest.mark.parametrize("reader", READERS)
def test_each_option_changes_what_is_read_or_is_refused(reader, option, tmp_path):
    name, table, needed, refused = READERS[reader]
    path, options = tmp_path / name, {"sigma": 0.1, **needed}
    given = options | {option: OPTIONS[option]}
    table(option == "not_finite").write(path)
    if option in refused:
        with pytest.raises(InputError, match=f"option '{option}'|unit|tangent point"):
            read_matches(path, **given)
        return
    if option == "not_finite":
        with pytest.raises(InputError, match="leave out 1 of 8 with data"):
            read_matches(path, **options)
        assert len(read_matches(path, **given)) == 7
        return
    before, after = vars(read_matches(path, **options)), vars(read_matches(path, **given))
    assert after.keys() != before.keys() or any(
        not np.array_equal(after[key], before[key]) for key in after
    )


@pytest.mark.plugins
@pytest.mark.parametrize("option", OPTIONS)
def test_lists_and_saved_matches_refuse_options_that_they_fix(option, tmp_path, data_dir):
    star_table(("x", "y", "u", "v")).write(tmp_path / "a.fits")
    matches = read_matches(tmp_path / "a.fits", unit="pix", sigma=1.0)
    write_matches(tmp_path / "matches.h5", matches)
    files = tmp_path / "matches.h5", next((data_dir / "hst1pass_uvis").glob("*_flt.*"))
    for path, format in zip(files, ("bayesdist", "hst1pass"), strict=True):
        with pytest.raises(InputError, match=f"option '{option}' is given, but the format"):
            read_matches(path, format=format, **{option: OPTIONS[option]})


def test_the_origin_that_a_format_has_may_be_stated(rng, tmp_path):
    x, y = rng.uniform(1, 100, (2, 9))
    write_matches(
        tmp_path / "matches.h5", Matches(x=x, y=y, u=x, v=y, unit="pix", mag=np.arange(9.0))
    )
    read = partial(read_matches, tmp_path / "matches.h5", sigma="by_magnitude")
    assert (read(pixel_origin=1).x == x).all()
    with pytest.raises(InputError, match="option 'pixel_origin' is given"):
        read(pixel_origin=0)
