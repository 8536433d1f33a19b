"""Errors of centroids in pixels become errors of matches."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.data import ReadOptions, open_matches
from bayesdist.errors import InputError
from tests.data.tables import matches_from_table

N, SCALE, ANGLE = 400, 0.05, 0.6  # arcsec in a pixel, radians
R = np.array([[np.cos(ANGLE), -np.sin(ANGLE)], [np.sin(ANGLE), np.cos(ANGLE)]])


def stars(rng, *, distorted: float = 0.0, **columns) -> Table:
    """Stars of a turned camera, one in twenty of which is a false match."""
    x, y = rng.uniform(1, 2000, (2, N))
    u, v = SCALE * R @ camera(x, y, distorted)
    wrong = rng.uniform(size=N) < 0.05
    u, v = (z + wrong * rng.normal(0, 0.5, N) for z in (u, v))
    return Table({"x": x, "y": y, "u": u, "v": v, **columns})


def camera(x, y, distorted):
    X, Y = (x - 1000) / 1000, (y - 1000) / 1000
    return np.stack([x + distorted * X**2 * Y, y - distorted * X * Y**2])


def covariances(matches) -> np.ndarray:
    mixed = matches.rho_uv * matches.sigma_u * matches.sigma_v
    rows = [[matches.sigma_u**2, mixed], [mixed, matches.sigma_v**2]]
    return np.moveaxis(np.array(rows), -1, 0)


def pixel_covariances(table) -> np.ndarray:
    mixed = table["rho_xy"] * table["x_err"] * table["y_err"]
    rows = [[table["x_err"] ** 2, mixed], [mixed, table["y_err"] ** 2]]
    return np.moveaxis(np.array(rows), -1, 0)


def test_the_covariance_is_turned_and_scaled_and_added_to_that_of_the_catalogue(rng):
    errors = {"x_err": rng.uniform(0.01, 0.1, N), "y_err": rng.uniform(0.01, 0.1, N)}
    table = stars(rng, rho_xy=rng.uniform(-0.9, 0.9, N), **errors)
    expected = SCALE**2 * R @ pixel_covariances(table) @ R.T
    found = matches_from_table(table, ReadOptions(unit="arcsec"))
    np.testing.assert_allclose(covariances(found), expected, rtol=1e-3, atol=1e-9)
    assert any("converted from pixels" in note for note in found.notes)
    # those of the whole match leave nothing to be added
    table["sigma_u"] = table["sigma_v"] = 0.002
    assert (matches_from_table(table, ReadOptions(unit="arcsec")).sigma_u == 0.002).all()


def test_catalogue_errors_on_the_sky_are_added(rng):
    table = stars(rng, x_err=np.full(N, 0.02), y_err=np.full(N, 0.04))
    point = (150.0, 2.0)
    table["ra"] = point[0] + table["u"] / 3600 / np.cos(np.radians(point[1]))
    table["dec"] = point[1] + table["v"] / 3600
    table["ra_error"], table["dec_error"], table["ra_dec_corr"] = 1.0, 2.0, 0.5
    for name in ("ra_error", "dec_error"):
        table[name].unit = "mas"
    table.remove_columns(["u", "v"])
    found = matches_from_table(table, ReadOptions(tangent_point=point))
    own = SCALE**2 * R @ np.diag([0.02**2, 0.04**2]) @ R.T
    catalogue = 1e-6 * np.array([[1.0, 1.0], [1.0, 4.0]])
    np.testing.assert_allclose(covariances(found), np.tile(own + catalogue, (N, 1, 1)), rtol=2e-3)


def test_the_scale_is_that_at_the_star(rng):
    """A distortion that changes the scale by some percent from the middle to the corners."""
    table = stars(rng, distorted=40.0, x_err=np.full(N, 0.02), y_err=np.full(N, 0.02))
    found = matches_from_table(table, ReadOptions(unit="arcsec"))
    step = 0.5
    x, y = np.asarray(table["x"]), np.asarray(table["y"])
    by_x = (camera(x + step, y, 40.0) - camera(x - step, y, 40.0)) / (2 * step)
    by_y = (camera(x, y + step, 40.0) - camera(x, y - step, 40.0)) / (2 * step)
    J = np.moveaxis(np.stack([by_x, by_y], axis=1), -1, 0)
    J = SCALE * R @ J
    expected = 0.02**2 * J @ np.swapaxes(J, 1, 2)
    assert np.ptp(expected[:, 0, 0]) > 0.1 * expected[:, 0, 0].mean()
    np.testing.assert_allclose(found.sigma_u, np.sqrt(expected[:, 0, 0]), rtol=0.05)


def test_exposures_that_are_turned_have_their_own_axes(rng):
    table = stars(rng, x_err=np.full(N, 0.01), y_err=np.full(N, 0.05))
    second = np.arange(N) % 2 == 1
    u, v = np.asarray(table["u"]), np.asarray(table["v"])
    table["u"], table["v"] = np.where(second, -v, u), np.where(second, u, v)
    table["exposure"] = np.where(second, "b", "a")
    found = covariances(matches_from_table(table, ReadOptions(unit="arcsec")))
    np.testing.assert_allclose(found[1, 0, 0], found[0, 1, 1], rtol=1e-3)
    np.testing.assert_allclose(found[1, 0, 1], -found[0, 0, 1], rtol=1e-3)


def test_sextractor_has_variances_and_a_covariance(rng):
    table = stars(rng)
    table["ERRX2WIN_IMAGE"], table["ERRY2WIN_IMAGE"] = 0.02**2, 0.03**2
    table["ERRXYWIN_IMAGE"] = 0.6 * 0.02 * 0.03
    found = matches_from_table(table, ReadOptions(unit="arcsec"))
    C = np.array([[0.0004, 0.00036], [0.00036, 0.0009]])
    np.testing.assert_allclose(
        covariances(found), np.tile(SCALE**2 * R @ C @ R.T, (N, 1, 1)), rtol=2e-3
    )


@pytest.mark.parametrize("kind", ["", "WIN", "PSF"])
def test_sextractor_has_ellipses(rng, kind):
    """Semi-axes and the angle from x to y, as matplotlib or ds9 draw them."""
    table, angle = stars(rng), rng.uniform(-90, 90, N)
    a, b = rng.uniform(0.02, 0.06, N), rng.uniform(0.005, 0.02, N)
    table[f"ERRA{kind}_IMAGE"], table[f"ERRB{kind}_IMAGE"] = a, b
    table["ERRTHTPSF_IMAGE" if kind == "PSF" else f"ERRTHETA{kind}_IMAGE"] = angle
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    turn = np.moveaxis(np.array([[c, -s], [s, c]]), -1, 0)
    axes = np.array([np.diag(pair) for pair in np.stack([a**2, b**2], axis=1)])
    expected = SCALE**2 * R @ turn @ axes @ np.swapaxes(turn, 1, 2) @ R.T
    found = matches_from_table(table, ReadOptions(unit="arcsec"))
    np.testing.assert_allclose(covariances(found), expected, rtol=2e-3, atol=1e-9)
    # variances alone are completed by the covariance of the ellipse
    C = turn @ axes @ np.swapaxes(turn, 1, 2)
    table[f"ERRX2{kind}_IMAGE"], table[f"ERRY2{kind}_IMAGE"] = C[:, 0, 0], C[:, 1, 1]
    found = matches_from_table(table, ReadOptions(unit="arcsec"))
    np.testing.assert_allclose(covariances(found), expected, rtol=2e-3, atol=1e-9)
    table[f"ERRB{kind}_IMAGE"][6] = 0.0
    with pytest.raises(InputError, match=f"row 7, column 'ERRB{kind}_IMAGE'"):
        matches_from_table(table, ReadOptions(unit="arcsec"))
    # errors that are not used are not refused
    for options in ({"sigma": "by_magnitude"}, {"sigma": 0.01}):
        assert len(matches_from_table(table, ReadOptions(unit="arcsec", **options))) == N
    with_own = table.copy()
    with_own["sigma_u"] = with_own["sigma_v"] = 0.01
    assert np.all(matches_from_table(with_own, ReadOptions(unit="arcsec")).sigma_u == 0.01)
    # errors of another program stand beside them
    table["x_err"] = table["y_err"] = 0.01
    table.remove_columns([f"ERRX2{kind}_IMAGE", f"ERRY2{kind}_IMAGE"])
    found = matches_from_table(table, ReadOptions(unit="arcsec"))
    np.testing.assert_allclose(found.sigma_u, 0.01 * SCALE, rtol=2e-3)


def test_stars_on_disk_have_the_same_errors(rng, tmp_path):
    table = stars(rng, x_err=np.full(N, 0.02), y_err=np.full(N, 0.04))
    table.write(tmp_path / "stars.parquet")
    stored = open_matches(tmp_path / "stars.parquet", unit="arcsec").load()
    here = matches_from_table(table, ReadOptions(unit="arcsec"))
    for name in ("sigma_u", "sigma_v", "rho_uv"):
        np.testing.assert_allclose(getattr(stored, name), getattr(here, name), rtol=1e-12)


def test_ellipses_on_disk_are_refused_and_variances_are_read(rng, tmp_path):
    table = stars(rng)
    table["ERRA_IMAGE"], table["ERRB_IMAGE"] = 0.04, 0.01
    table["ERRTHETA_IMAGE"] = 0.0
    table.write(tmp_path / "ellipses.parquet")
    with pytest.raises(InputError, match=r"ERRA_IMAGE, .* write the variances as errx2_image"):
        open_matches(tmp_path / "ellipses.parquet", unit="arcsec")
    open_matches(tmp_path / "ellipses.parquet", unit="arcsec", sigma=0.01)
    here = matches_from_table(table, ReadOptions(unit="arcsec"))
    table["errx2_image"], table["erry2_image"] = 0.04**2, 0.01**2
    table["errxy_image"] = 0.0
    table.write(tmp_path / "variances.parquet")
    stored = open_matches(tmp_path / "variances.parquet", unit="arcsec").load()
    np.testing.assert_allclose(covariances(stored), covariances(here), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize(
    ("column", "values", "words"),
    [
        ("x_err", 0.0, "error of a pixel coordinate is 0"),
        ("y_err", -0.1, "error of a pixel coordinate is -0.1"),
        ("rho_xy", 1.0, "impossible beside the errors"),
    ],
)
def test_impossible_errors_are_refused_with_row_and_column(rng, column, values, words):
    table = stars(rng, x_err=np.full(N, 0.02), y_err=np.full(N, 0.02), rho_xy=np.zeros(N))
    table[column][4] = values
    with pytest.raises(InputError, match=words) as refused:
        matches_from_table(table, ReadOptions(unit="arcsec"))
    assert "row 5" in str(refused.value) and column in str(refused.value)


def test_errors_in_another_unit_are_refused(rng):
    table = stars(rng, x_err=np.full(N, 0.02), y_err=np.full(N, 0.02))
    table["x_err"].unit = "arcsec"
    with pytest.raises(InputError, match="errors of pixels are in pix"):
        matches_from_table(table, ReadOptions(unit="arcsec"))


def test_matches_on_a_line_do_not_say_how_large_a_pixel_is(rng):
    table = stars(rng, x_err=np.full(N, 0.02), y_err=np.full(N, 0.02))
    table["y"] = 2 * table["x"]
    with pytest.raises(InputError, match="400 matches do not determine the size of a pixel"):
        matches_from_table(table, ReadOptions(unit="arcsec"))


def test_unused_ellipses_on_disk_are_not_refused(rng, tmp_path):
    table = stars(rng)
    table["ERRA_IMAGE"], table["ERRB_IMAGE"], table["ERRTHETA_IMAGE"] = 0.03, 0.02, 0.0
    table["ERRX2_IMAGE"], table["ERRY2_IMAGE"] = 0.03**2, 0.02**2
    table.write(tmp_path / "both.parquet")
    disk = open_matches(tmp_path / "both.parquet", unit="arcsec")
    here = matches_from_table(table, ReadOptions(unit="arcsec"))
    np.testing.assert_allclose(covariances(disk.load()), covariances(here), rtol=1e-9, atol=1e-15)
    assert any("taken as uncorrelated" in note for note in disk.notes)
    table.remove_columns(["ERRX2_IMAGE", "ERRY2_IMAGE"])
    without = dict.fromkeys(("sigma_x", "sigma_y", "rho_xy"), "")
    table["ra"], table["dec"] = 150.0 + table["u"] / 3600, 2.0 + table["v"] / 3600
    table["ra_error"], table["dec_error"] = 1.0, 1.0
    for name, unit in (("ra", "deg"), ("dec", "deg"), ("ra_error", "mas"), ("dec_error", "mas")):
        table[name].unit = unit
    table.remove_columns(["u", "v"])
    table.write(tmp_path / "ellipses.parquet")
    stored = open_matches(tmp_path / "ellipses.parquet", columns=without).load()
    np.testing.assert_allclose(stored.sigma_u, 0.001, rtol=1e-3)


def test_a_named_column_of_fluxes_is_refused_on_disk(rng, tmp_path):
    stars(rng, FLUX=np.full(N, 100.0)).write(tmp_path / "stars.parquet")
    options = {"unit": "arcsec", "sigma": 0.01}
    with pytest.raises(InputError, match="'FLUX' is named for 'flux', which is not read"):
        open_matches(tmp_path / "stars.parquet", columns={"flux": "FLUX"}, **options)
    open_matches(tmp_path / "stars.parquet", **options)
