from __future__ import annotations

import astropy.units as apu
import numpy as np
import pytest
from astropy.table import MaskedColumn, QTable, Table
from astropy.time import Time

from bayesdist.data import Matches, ReadOptions, tangent_plane
from bayesdist.errors import InputError
from tests.data.tables import matches_from_table


def stars(n=6, **more):
    k = np.arange(1.0, n + 1)
    return Table({"x": 100 * k, "y": 50 * k + k**2, "u": k, "v": 2 * k, **more})


def read(table, columns=None, **options):
    options = ReadOptions(columns, **{"unit": "pix", **options})
    return matches_from_table(table, options, source="stars.ecsv")


def test_usual_names_in_any_case():
    t = Table(
        {"X": [1.0, 2], "Y": [1.0, 2], "U": [3.0, 4], "V": [3.0, 4], "SU": [0.1, 0.2],
         "u_error": [9.0, 9], "sv": [0.3, 0.4], "CCDCHIP": [2, 1], "FRAME": ["b", "a"],
         "Mag": [1.0, 2], "Color": [0.5, 0.7], "filter": ["F606W", "F606W"]}
    )  # fmt: skip
    m = read(t)
    assert m.sigma_u.tolist() == [0.1, 0.2] and m.sigma_v.tolist() == [0.3, 0.4]
    assert m.chip_numbers == (1, 2) and m.chip.tolist() == [1, 0]
    # the first exposure defines the gauge, so the order is that of the file
    assert m.exposure_names == ("b", "a") and m.exposure.tolist() == [0, 1]
    assert m.filter_names == ("F606W",) and m.mag.tolist() == [1, 2]
    assert m.colour.tolist() == [0.5, 0.7]


def test_a_mapping_wins_over_usual_names_and_can_leave_out():
    t = stars(mag=np.arange(6.0), xc=np.arange(6.0) + 0.5, colour=np.ones(6), bv=np.arange(6.0))
    m = read(t, {"x": "xc", "mag": "", "colour": "bv"})
    assert m.colour.tolist() == [0, 1, 2, 3, 4, 5]
    assert m.x.tolist() == [0.5, 1.5, 2.5, 3.5, 4.5, 5.5] and m.mag is None


@pytest.mark.parametrize(
    ("columns", "options", "reason"),
    [
        ({"sigma_u": "a", "sigma_v": "b"}, {"sigma": "by_magnitude"}, "sigma is 'by_magnitude'"),
        ({"sigma_x": "a", "sigma_y": "b"}, {"sigma": 0.1}, "data.sigma is 0.1"),
        ({"sigma_x": "a", "sigma_y": "b"}, {}, "column 'su' has the errors of u"),
        ({"pm_ra": "a", "pm_dec": "b"}, {}, "the reference positions are u and v"),
        ({"flux": "a"}, {}, "column 'mag' has magnitudes"),
    ],
)
def test_named_columns_that_are_not_read_are_refused(columns, options, reason):
    t = stars(mag=np.arange(6.0), a=np.ones(6), b=np.ones(6))
    if "sigma" not in options:
        t["su"] = t["sv"] = 0.1
    with pytest.raises(InputError, match=f"column 'a' is named for .*{reason}"):
        read(t, columns, **options)


def test_an_epoch_of_the_catalogue_without_one_of_the_exposures_is_refused():
    t = Table({"x": [1.0, 9], "y": [1.0, 9], "ra": [1.0, 1.001], "dec": [0.0, 0.001]})
    t["pmra"], t["pmdec"] = [1.0, 2.0], [3.0, 4.0]
    with pytest.raises(InputError, match="epoch of the exposures is not known"):
        read(t, unit=None, sigma=0.1, catalogue_epoch=2016.0)


def test_a_missing_column_is_answered_with_the_nearest():
    with pytest.raises(InputError, match=r"stars\.ecsv: column 'xcen' is missing; name 'x_cen'"):
        read(stars(x_cen=np.ones(6)), {"x": "xcen"})
    with pytest.raises(InputError, match=r"key 'sigmau'.*'sigma_u'"):
        read(stars(), {"sigmau": "x"})
    with pytest.raises(InputError, match=r"no column for 'u', 'v' among x, y, w; .*u=NAME,v=NAME"):
        read({"x": [1.0], "y": [1.0], "w": [1.0]})


def test_text_among_numbers_is_named():
    t = stars()
    t["u"] = ["1", "2", "abc", "4", "5", "6"]
    with pytest.raises(InputError, match=r"row 3, column 'u': 'abc' is not a number"):
        read(t)
    t["u"] = [True] * 6
    with pytest.raises(InputError, match="column 'u': holds values of type bool"):
        read(t)


def test_rows_with_missing_values_are_left_out_and_counted():
    t = stars(su=np.ones(6), sv=np.ones(6))
    t["sv"] = MaskedColumn(np.full(6, 99999.0), mask=[0, 0, 0, 1, 0, 1])
    t["sv"][[0, 1, 2, 4]] = 0.5
    m = read(t)
    assert m.rejected == {"no value in column 'sv'": 2} and m.n_rows == 6
    assert m.row.tolist() == [0, 1, 2, 4] and m.sigma_v.tolist() == [0.5] * 4
    t["u"][4] = np.nan  # the row is named as the file has it
    with pytest.raises(InputError, match=r"row 5, column 'u': value is nan"):
        read(t)
    m = read(t, not_finite="reject")
    assert m.rejected == {"no value in column 'u'": 1, "no value in column 'sv'": 2}
    assert m.row.tolist() == [0, 1, 2]
    t["sv"].mask = True
    with pytest.raises(InputError, match=r"no row has a value in every column.*'sv' \(6 rows\)"):
        read(t)
    with pytest.raises(InputError, match="not_finite is 'drop'"):
        read(t, not_finite="drop")


@pytest.mark.parametrize("value", [0.0, -0.1, np.nan])
def test_bad_errors_are_named(value):
    t = stars(su=np.ones(6), sv=np.ones(6))
    t["su"][4] = value
    with pytest.raises(InputError, match=r"stars\.ecsv, row 5, column 'su'"):
        read(t)


def test_units_come_from_the_file():
    t = stars(su=np.full(6, 2.0), sv=np.full(6, 2.0))
    for name, unit in (("x", "pix"), ("u", "arcsec"), ("v", "arcsec"), ("su", "mas")):
        t[name].unit = unit
    m = read(t, unit=None)
    assert m.unit == "arcsec"
    # 2 mas are 0.002 arcsec; without a unit the error is in that of u, v
    assert m.sigma_u == pytest.approx(0.002) and m.sigma_v == pytest.approx(2.0)


def test_quantities_are_columns_with_units():
    k = np.arange(1.0, 4.0)
    t = QTable({"x": k * apu.pix, "y": k * apu.pix, "u": k * apu.mas, "v": k * apu.mas})
    assert read(t, unit=None).unit == "mas"


def test_units_missing_or_contradictory():
    t = stars()
    with pytest.raises(InputError, match="column 'u': has no unit"):
        read(t, unit=None)
    t["u"].unit = "arcsec"
    with pytest.raises(InputError, match="unit is arcsec in the file, but pix in the options"):
        read(t)
    t["v"].unit = "mas"
    with pytest.raises(InputError, match="column 'v': unit is mas, but arcsec in column 'u'"):
        read(t, unit=None)
    t["u"].unit = t["v"].unit = "m"
    with pytest.raises(InputError, match="unit is 'm'"):
        read(t, unit=None)
    t = stars(su=np.ones(6), sv=np.ones(6))
    t["su"].unit = "mas"
    with pytest.raises(InputError, match="column 'su': unit mas cannot be converted to pix"):
        read(t)
    t = stars()
    t["x"].unit = "mm"
    with pytest.raises(InputError, match="column 'x': unit is mm"):
        read(t)
    with pytest.raises(InputError, match="unit is 'feet'"):
        read(stars(), unit="feet")


def test_the_origin_of_pixels_moves_x_and_y_only():
    zero, one = read(stars(), pixel_origin=0), read(stars())
    assert (zero.x == one.x + 1).all() and (zero.y == one.y + 1).all()
    assert (zero.u == one.u).all()
    with pytest.raises(InputError, match="pixel_origin is 2"):
        read(stars(), pixel_origin=2)


def test_epochs_in_all_their_forms_agree():
    iso = [
        "2004-07-02",
        "2012-01-01",
        "2009-05-14T12:00:00",
        "2002-03-01",
        "2014-12-31",
        "2000-06-01",
    ]
    years = Time(iso, scale="tt").decimalyear
    assert years[0] == pytest.approx(2004 + 183 / 366)  # 2 July is day 184 of a leap year
    mjd = stars(epoch=Time(iso, scale="tt").mjd)
    mjd["epoch"].unit = "d"
    for t in (
        stars(epoch=iso),
        stars(epoch=np.array(iso, "S")),
        stars(epoch=years),
        stars(epoch=Time(iso, scale="tt")),
        stars(epoch=np.array(iso, "M8[s]")),
        mjd,
    ):
        np.testing.assert_allclose(read(t).epoch, years, rtol=0, atol=1e-9)


def test_epochs_that_are_none():
    with pytest.raises(InputError, match="row 1, column 'epoch': epoch is 53188"):
        read(stars(epoch=np.full(6, 53188.0)))
    with pytest.raises(InputError, match="row 2, column 'epoch': 'spring' is not a date"):
        read(stars(epoch=["2004-01-01", "spring"] * 3))
    t = stars(epoch=np.full(6, 5.0))
    t["epoch"].unit = "m"
    with pytest.raises(InputError, match="unit m is not a unit of dates"):
        read(t)


def test_epochs_in_columns_of_objects():
    years = [2016.0, "2016.0", 2016, "2016-01-01T12:00:00", 2016.0, 2016.0]
    read_years = read(stars(epoch=np.array(years, object))).epoch
    assert read_years == pytest.approx(2016.0, abs=2e-3)
    structures = np.array([{"a": 1.0}] * 6, object)
    with pytest.raises(InputError, match=r"row 1, column 'epoch': .* is not a date"):
        read(stars(epoch=structures))


def test_labels_of_every_type():
    for labels in (
        [7, 7, 3, 3, 7, 9],
        ["7", "7 ", "3", "3", "7", "9"],
        [b"7", b"7", b"3", b"3", b"7", b"9"],
    ):
        m = read(stars(exposure=labels))
        assert m.exposure_names == ("7", "3", "9")
        assert m.exposure.tolist() == [0, 0, 1, 1, 0, 2]
    several = np.array([{"a": 1}, "b", "b", "b", "b", "b"], object)
    with pytest.raises(InputError, match="row 1, column 'exposure': there are several values"):
        read(stars(exposure=several))


def test_chips_are_whole_numbers():
    with pytest.raises(InputError, match=r"row 1, column 'chip': value is 1\.5"):
        read(stars(chip=np.full(6, 1.5)))


def test_sky_positions_come_to_the_tangent_plane(rng):
    ra, dec = 15.8 + rng.uniform(-0.1, 0.1, 6), -70.8 + rng.uniform(-0.1, 0.1, 6)
    t = stars()
    t.remove_columns(["u", "v"])
    t["ra"], t["dec"] = ra, dec
    m = read(t, unit=None, tangent_point=(15.8, -70.8))
    assert m.unit == "arcsec" and m.tangent_point == (15.8, -70.8)
    np.testing.assert_allclose([m.u, m.v], tangent_plane(ra, dec, (15.8, -70.8)))
    own = read(t, unit=None)
    assert abs(own.u.mean()) < 0.5 and abs(own.v.mean()) < 0.5  # about the middle of the stars
    t["ra"] = (ra * apu.deg).to(apu.hourangle)
    hours = read(t, unit=None, tangent_point=(15.8, -70.8))
    np.testing.assert_allclose(hours.u, m.u, atol=1e-7)
    with pytest.raises(InputError, match="unit is pix, but sky positions"):
        read(t)
    t["dec"][2] = 91.0
    with pytest.raises(InputError, match="row 3, column 'dec': declination is 91"):
        read(t, unit=None)


def test_one_pair_of_reference_columns():
    t = stars(ra=np.ones(6), dec=np.ones(6))
    assert read(t).tangent_point is None  # u, v are there
    assert read(t, {"ra": "ra", "dec": "dec"}, unit=None, tangent_point=(1, 1)).unit == "arcsec"
    with pytest.raises(InputError, match="both u, v and ra, dec"):
        read(t, {"u": "u", "ra": "ra"})
    with pytest.raises(InputError, match="a tangent point is given"):
        read(t, tangent_point=(1.0, 1.0))


def test_inputs_stay_as_they_are():
    t = stars(su=np.ones(6), sv=np.ones(6))
    before = t.copy()
    m = read(t, pixel_origin=0)
    m.u[:] = 0.0
    assert (t["x"] == before["x"]).all() and t.colnames == before.colnames


@pytest.mark.parametrize("unit", [None, "pix", "mm"])
def test_lengths_are_refused_with_what_to_do(unit):
    """u and v in millimetres of a focal plane."""
    t = stars()
    for name in ("u", "v"):
        t[name].unit = "mm"
    with pytest.raises(
        InputError, match="divide u, v and their errors by the size of a pixel in mm"
    ):
        read(t, unit=unit)


@pytest.mark.parametrize(("unit", "size"), [("mm", 1.0), ("um", 1e-3), ("cm", 10.0)])
@pytest.mark.parametrize("stated", [True, False])
def test_lengths_become_arcsec_by_the_plate_scale(unit, size, stated):
    """12.5 arcsec per mm; errors in the same unit, in another length, and in an angle."""
    t = stars()
    sky = read(t, unit="arcsec")
    for name in ("u", "v"):
        t[name].unit = unit if stated else None
    t["su"], t["sv"] = 2.0 if stated else 0.002 / size, 0.05
    t["sv"].unit = "arcsec"
    t["su"].unit = "um" if stated else None
    columns = {"sigma_u": "su", "sigma_v": "sv"}
    given = None if stated else unit
    m = read(t, unit=given, plate_scale=12.5, columns=columns)
    assert m.unit == "arcsec" and "12.5 arcsec per mm" in " ".join(m.notes)
    np.testing.assert_allclose(m.u, 12.5 * size * sky.u, rtol=1e-14)
    np.testing.assert_allclose(m.sigma_u, 0.025, rtol=1e-14)
    np.testing.assert_allclose(m.sigma_v, 0.05)


def test_a_number_for_sigma_is_in_the_length_that_is_stated():
    t = stars()
    t = t["x", "y", "u", "v"]
    m = Matches.from_table(t, unit="um", sigma=2.0, plate_scale=12.5)
    np.testing.assert_allclose(m.sigma_u, 0.025, rtol=1e-14)
    m = Matches.from_table(t, unit="mm", sigma=2.0 * apu.um, plate_scale=12.5)
    np.testing.assert_allclose(m.sigma_v, 0.025, rtol=1e-14)
    for name in ("u", "v"):
        t[name].unit = "mm"
    with pytest.raises(InputError, match="u and v are in a length that only the file states"):
        Matches.from_table(t, sigma=2.0, plate_scale=12.5)


@pytest.mark.parametrize("unit", ["pix", "arcsec", None])
def test_a_plate_scale_beside_what_is_no_length_is_refused(unit):
    with pytest.raises(InputError, match="a plate scale is given, and the unit is"):
        read(stars(), unit=unit, plate_scale=12.5)
    with pytest.raises(InputError, match="give a positive number of arcsec per mm"):
        ReadOptions(plate_scale=0.0)
