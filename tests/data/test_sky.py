"""Catalogues' units, motions and errors, against vectors in space and against draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord, get_body_barycentric
from astropy.table import MaskedColumn, QTable, Table
from astropy.time import Time

from bayesdist.data import ReadOptions, open_matches, read_catalog, tangent_plane
from bayesdist.errors import InputError
from tests.data.tables import matches_from_table

POINT = (83.0, -66.0)  # near the pole of the ecliptic: parallaxes on both axes
MAS = np.radians(1 / 3600e3)
GAIA = {"ra_error": 0.3, "dec_error": 0.2, "pmra_error": 0.4, "pmdec_error": 0.1,
        "parallax_error": 0.25, "ref_epoch": 2016.0}  # fmt: skip


def catalogue(n=40, seed=1, **more):
    rng = np.random.default_rng(seed)
    t = Table({"x": rng.uniform(1, 1000, n), "y": rng.uniform(1, 1000, n),
               "source_id": np.arange(n), "phot_g_mean_mag": rng.uniform(15, 20, n),
               "ra": POINT[0] + rng.uniform(-0.1, 0.1, n),
               "dec": POINT[1] + rng.uniform(-0.04, 0.04, n), "pmra": rng.normal(0, 800, n),
               "pmdec": rng.normal(0, 800, n), "parallax": rng.uniform(0, 50, n)})  # fmt: skip
    for name, value in (GAIA | more).items():
        t[name] = value
    return t


def read(t, **options):
    return matches_from_table(t, ReadOptions(tangent_point=POINT, **options), source="gaia.csv")


def directions(t):
    """Unit vectors, and those to the east and north."""
    a, d = np.radians(np.asarray(t["ra"])), np.radians(np.asarray(t["dec"]))
    r = np.array([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)])
    east = np.array([-np.sin(a), np.cos(a), 0 * a])
    north = np.array([-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)])
    return r, east, north


def on_plane(vectors):
    r = vectors / np.linalg.norm(vectors, axis=0)
    ra, dec = np.degrees(np.arctan2(r[1], r[0])), np.degrees(np.arcsin(r[2]))
    return np.array(tangent_plane(ra, dec, POINT))


def test_positions_move_on_straight_lines_in_space_and_are_seen_from_the_earth():
    t, epoch = catalogue(), 1999.37
    m = read(t, epoch=epoch)
    r, east, north = directions(t)
    dt = epoch - 2016.0
    mu = MAS * (east * np.asarray(t["pmra"]) + north * np.asarray(t["pmdec"]))
    when = Time(epoch, format="jyear", scale="tdb")
    earth = get_body_barycentric("earth", when, ephemeris="builtin").xyz.to_value("au")
    # from the Earth: the star is 1 / parallax away
    seen = r + mu * dt - MAS * np.asarray(t["parallax"]) * earth[:, None]
    expected = on_plane(seen)
    # the factors are those of the middle of the field, and of first order: 50 mas x 0.04 deg
    np.testing.assert_allclose([m.u, m.v], expected, atol=1e-4)
    without = read(t, epoch=epoch, columns={"parallax": ""})
    np.testing.assert_allclose([without.u, without.v], on_plane(r + mu * dt), atol=2e-6)
    assert np.hypot(without.u - m.u, without.v - m.v).max() > 0.02
    (note,) = m.notes
    assert note.startswith("positions of 2016.00 were moved to 1999.37 by proper motions and par")
    assert m.epoch.tolist() == [epoch] * len(t)
    np.testing.assert_allclose(m.pm_u, np.asarray(t["pmra"]) / 1e3, atol=2e-3 * 3)
    # the date may be a column, or stand in the header
    t.meta["DATE-OBS"] = Time(epoch, format="decimalyear", scale="tt").isot
    np.testing.assert_allclose(read(t).u, m.u, atol=1e-5)
    t["mjd"] = Time(epoch, format="decimalyear", scale="tt").mjd
    np.testing.assert_allclose(read(t).u, m.u, atol=1e-5)
    with pytest.raises(InputError, match="'mjd': an epoch of the exposures is given"):
        read(t, epoch=epoch)


def test_errors_grow_with_those_of_motions_and_parallaxes(rng):
    """Standard deviations of draws from a correlated catalogue, propagated one by one."""
    t = catalogue(ra_pmra_corr=-0.6, dec_pmdec_corr=0.3)
    m = read(t, epoch=2003.1)
    dt, n = 2003.1 - 2016.0, 200_000
    when = Time(2003.1, format="jyear", scale="tdb")
    earth = get_body_barycentric("earth", when, ephemeris="builtin").xyz.to_value("au")
    _, east, north = directions(t[:1])
    found = []
    for axis, s, s_pm, rho in ((east, 0.3, 0.4, -0.6), (north, 0.2, 0.1, 0.3)):
        cov = [[s**2, rho * s * s_pm], [rho * s * s_pm, s_pm**2]]
        d = rng.multivariate_normal([0, 0], cov, n) @ [1, dt]
        d = d - rng.normal(0, 0.25, n) * float(earth @ axis[:, 0])
        found.append(d.std() / 1e3)
    np.testing.assert_allclose([m.sigma_u[0], m.sigma_v[0]], found, rtol=0.012)
    # at the epoch of the catalogue they are its own, mas as Gaia has them
    same = read(t, epoch=2016.0, columns={"parallax": "", "sigma_parallax": ""})
    np.testing.assert_allclose(same.sigma_u, 0.3e-3, rtol=1e-3)
    np.testing.assert_allclose(same.sigma_v, 0.2e-3, rtol=1e-3)


def test_units_by_name_need_the_company_of_the_catalogue():
    t = catalogue()
    t.keep_columns(["x", "y", "ra", "dec", "ra_error", "dec_error"])
    with pytest.raises(InputError, match=r"column 'ra_error': has no unit.*sigma_ra = \"\""):
        read(t)
    assert read(t, columns={"sigma_ra": "", "sigma_dec": ""}).sigma_u is None
    t["ra_error"].unit = t["dec_error"].unit = "arcsec"
    assert read(t).sigma_u == pytest.approx(0.3, rel=1e-4)
    t = catalogue()
    t["pmra"].unit = "arcsec / yr"  # what the file says wins
    moved = read(t, epoch=2016.001, columns={"parallax": ""})
    assert np.abs(moved.pm_u).max() > 100


def test_motions_and_time_of_a_skycoord_are_used():
    """As of the same columns; a SkyCoord without them has positions alone."""
    t = catalogue()
    t.remove_columns(["parallax", *GAIA])
    sky = SkyCoord(
        t["ra"] * u.deg, t["dec"] * u.deg, pm_ra_cosdec=t["pmra"] * u.mas / u.yr,
        pm_dec=t["pmdec"] * u.mas / u.yr, obstime=Time(2016.0, format="jyear"),
    )  # fmt: skip
    given = QTable({"x": t["x"], "y": t["y"], "skycoord": sky})
    moved = read(given, epoch=2004.0)
    t["ref_epoch"] = 2016.0
    t["pmra"].unit = t["pmdec"].unit = "mas / yr"
    np.testing.assert_allclose(moved.u, read(t, epoch=2004.0).u, atol=1e-9)
    bare = QTable({"x": t["x"], "y": t["y"], "skycoord": SkyCoord(sky.ra, sky.dec)})
    assert np.abs(moved.u - read(bare).u).max() > 1


def test_without_an_epoch_nothing_moves_and_it_is_said():
    t = catalogue()
    still = read(t)
    assert still.notes == (
        "proper motions are not used: the epoch of the exposures is not given (data.epoch)",
    )
    expected = tangent_plane(t["ra"], t["dec"], POINT)
    np.testing.assert_allclose([still.u, still.v], expected)
    t.remove_column("ref_epoch")
    assert "data.catalogue_epoch" in read(t, epoch=2004.0).notes[0]
    given = read(t, epoch=2004.0, catalogue_epoch=2016.0)
    np.testing.assert_allclose(given.u, read(catalogue(), epoch=2004.0).u)


def test_stars_without_motion_are_left_out_where_the_table_has_no_errors_of_motions():
    t = catalogue()
    t.remove_columns(["pmra_error", "pmdec_error"])
    t["pmra"] = MaskedColumn(t["pmra"], mask=np.arange(40) < 3)
    t["pmdec"][5] = np.nan  # as FITS has it
    moved = read(t, epoch=2004.0)
    assert moved.rejected == {"no proper motion": 4} and len(moved) == 36 and moved.n_rows == 40
    assert len(read(t)) == 40
    t["parallax"][10] = np.nan  # a parallax that is not known is none
    assert len(read(t, epoch=2004.0)) == 36


def test_motions_of_exactly_zero_are_missing_values(tmp_path, caplog):
    """A third of a Gaia table filled with 0, as pandas and topcat write missing values."""
    truth = catalogue()
    t = truth.copy()
    filled = np.arange(40) % 3 == 0
    for name in ("pmra", "pmdec"):
        t[name][filled] = 0.0
    t["pmra"][1] = 0.0  # a zero on one axis may be measured
    truth["pmra"][1] = 0.0
    moved = read(t, epoch=2004.0)
    assert moved.rejected == {"proper motion of exactly 0": 14} and len(moved) == 26
    assert "gaia.csv: WARNING: 14 of 40 stars have pmra and pmdec of exactly 0" in caplog.text
    expected = read(truth[~filled], epoch=2004.0)
    np.testing.assert_allclose([moved.u, moved.v], [expected.u, expected.v], rtol=1e-12)
    assert len(read(t)) == 40  # nothing moves, and nothing is lost
    caplog.clear()
    t.write(tmp_path / "gaia.csv")
    found = read_catalog(tmp_path / "gaia.csv", tangent_point=POINT)
    assert len(found) == 26 and found.notes == (
        "14 stars are left out: proper motion of exactly 0",
    )
    assert "14 of 40 stars" in caplog.text
    for name in ("pmra", "pmdec"):
        t[name] = 0
    with pytest.raises(InputError, match=r"proper motion of exactly 0 \(40 rows\).*columns"):
        read(t, epoch=2004.0)


def test_motions_of_exactly_zero_are_missing_values_on_a_plane(tmp_path):
    t = Table({"u": [1.0, 2.0, 3.0], "v": [0.0, 1.0, 2.0], "pm_u": [0.1, 0.0, 0.0],
               "pm_v": [0.1, 0.0, 0.2]})  # fmt: skip
    t.write(tmp_path / "plane.csv")
    found = read_catalog(tmp_path / "plane.csv", unit="pix", epoch=2010.0)
    assert found.u.tolist() == [1.0, 3.0]


def test_motions_of_exactly_zero_are_refused_in_tables_on_disk_with_few_stars(tmp_path):
    t = catalogue(20)
    for name, unit in {"ra": "deg", "dec": "deg", "pmra": "mas / yr", "pmdec": "mas / yr"}.items():
        t[name].unit = unit
    t.remove_columns(["parallax", "parallax_error"])
    t["pmra"][7] = t["pmdec"][7] = 0.0
    t.write(tmp_path / "gaia.parquet")
    with pytest.raises(InputError, match=r"row 8, column 'pmra': proper motion is exactly 0"):
        open_matches(tmp_path / "gaia.parquet", epoch=2004.0)


def test_photometry_beside_sky_positions_is_no_plane():
    """U, B, V are magnitudes."""
    t = catalogue()
    for name in ("U", "B", "V"):
        t[name] = 15.0 + np.arange(40) / 100
    assert read(t).tangent_point == POINT


def test_a_catalogue_from_the_gaia_archive_needs_no_units(tmp_path):
    catalogue().write(tmp_path / "gaia.csv")
    found = read_catalog(tmp_path / "gaia.csv", tangent_point=POINT)
    assert found.sigma_u == pytest.approx(0.3e-3, rel=1e-3)
    np.testing.assert_allclose(found.pm_v, np.asarray(catalogue()["pmdec"]) / 1e3, atol=5e-3)


PARAMETERS = ("ra", "dec", "parallax", "pmra", "pmdec")


def gaia_star(rng, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors (5,) in mas and years, and a correlation matrix (5, 5) with large elements."""
    root = rng.standard_normal((5, 5)) + 1.5 * np.eye(5)[:, [1, 0, 3, 2, 4]]
    C = root @ root.T
    sigma = np.sqrt(np.diag(C))
    return np.array([0.3, 0.2, 0.4, 0.15, 0.1]), C / np.outer(sigma, sigma)


def gaia_table(values: np.ndarray, sigma=None, rho=None) -> Table:
    """Rows of the archive (n, 5): degrees, mas, mas / yr, with errors and correlations."""
    table = Table({"x": np.arange(len(values)) + 1.0, "y": np.full(len(values), 5.0)})
    for name, column in zip(PARAMETERS, values.T, strict=True):
        table[name] = column
    table["ref_epoch"], table["phot_g_mean_mag"] = 2016.0, 15.0
    if sigma is not None:
        for i, name in enumerate(PARAMETERS):
            table[f"{name}_error"] = sigma[i]
            for j in range(i):
                table[f"{PARAMETERS[j]}_{name}_corr"] = rho[i, j]
    return table


def test_all_correlations_of_gaia_come_to_the_epoch_of_the_exposure(rng):
    """Against positions of many catalogues with such errors, each moved by itself."""
    sigma, rho = gaia_star(rng, 1)
    star, point = np.array([83.0, -5.0, 2.0, 30.0, -20.0]), (83.0, -5.0)
    options = ReadOptions(tangent_point=point, epoch=2027.3)
    [found] = (matches_from_table(gaia_table(star[None], sigma, rho), options),)
    n = 20_000
    error = rng.multivariate_normal(np.zeros(5), rho * np.outer(sigma, sigma), n)
    error[:, 0] /= 3.6e6 * np.cos(np.radians(star[1]))
    error[:, 1] /= 3.6e6
    drawn = matches_from_table(gaia_table(star + error), replace(options, sigma=1.0))
    C = np.cov(drawn.u, drawn.v)
    assert found.sigma_u[0] == pytest.approx(np.sqrt(C[0, 0]), rel=0.02)
    assert found.sigma_v[0] == pytest.approx(np.sqrt(C[1, 1]), rel=0.02)
    expected = C[0, 1] / np.sqrt(C[0, 0] * C[1, 1])
    assert found.rho_uv[0] == pytest.approx(expected, abs=4 / np.sqrt(n))
    assert abs(expected) > 0.1


def test_correlations_that_no_covariance_has_are_refused_with_their_row(rng):
    sigma, rho = gaia_star(rng, 1)
    table = gaia_table(np.tile([83.0, -5.0, 2.0, 30.0, -20.0], (3, 1)), sigma, rho)
    options = ReadOptions(tangent_point=(83.0, -5.0), epoch=2027.3)
    table["ra_dec_corr"] = [0.1, 0.2, 1.5]
    with pytest.raises(InputError, match=r"row 3.*ra_dec_corr|ra_dec_corr.*row 3"):
        matches_from_table(table, options)
    table["ra_dec_corr"], table["ra_pmra_corr"], table["dec_pmra_corr"] = 0.99, 0.99, -0.99
    with pytest.raises(InputError, match="contradict each other"):
        matches_from_table(table, options)


def test_correlations_of_matches_on_a_plane_are_read_and_checked():
    table = Table({k: np.arange(1.0, 4.0) for k in "xyuv"})
    table["sigma_u"], table["sigma_v"], table["rho_uv"] = 0.1, 0.2, [0.0, 0.9, -0.5]
    found = matches_from_table(table, ReadOptions(unit="arcsec"))
    assert found.rho_uv.tolist() == [0.0, 0.9, -0.5]
    table["rho_uv"] = [0.0, 1.0, 0.2]
    with pytest.raises(InputError, match="row 2"):
        matches_from_table(table, ReadOptions(unit="arcsec"))
    table.remove_columns(["sigma_u", "sigma_v"])
    with pytest.raises(InputError, match="no errors"):
        matches_from_table(table, ReadOptions(unit="arcsec"))


def test_some_of_the_correlations_of_valid_stars_are_accepted(rng):
    """What is not given counts as zero, and need not go together with what is."""
    sigma, _ = gaia_star(rng, 1)
    kept = ("ra_dec_corr", "ra_pmra_corr", "dec_pmdec_corr")
    impossible = 0
    for k in range(300):
        _, rho = gaia_star(np.random.default_rng(k), 1)
        table = gaia_table(np.array([[83.0, -5.0, 2.0, 30.0, -20.0]] * 2), sigma, rho)
        table.remove_columns([n for n in table.colnames if n.endswith("_corr") and n not in kept])
        partial = np.where(np.eye(5) == 1, rho, 0.0)
        for i, j in ((0, 1), (0, 3), (1, 4)):
            partial[i, j] = partial[j, i] = rho[i, j]
        impossible += np.linalg.eigvalsh(partial)[0] < 0
        found = matches_from_table(table, ReadOptions(tangent_point=(83.0, -5.0), epoch=2027.3))
        assert np.isfinite(found.sigma_u).all() and (np.abs(found.rho_uv) < 1).all()
    assert impossible > 3


def test_batches_without_correlations_are_those_of_one_table(rng, tmp_path):
    sigma, rho = gaia_star(rng, 1)
    table = gaia_table(np.tile([83.0, -5.0, 2.0, 30.0, -20.0], (300, 1)), sigma, rho)
    table["x"], table["ra"] = np.arange(300) + 1.0, 83.0 + 1e-5 * np.arange(300)
    for name in [n for n in table.colnames if n.endswith("_corr")]:
        table[name] = np.where(np.arange(300) < 150, table[name], 0.0)
    table.write(tmp_path / "gaia.parquet")
    options = {"tangent_point": (83.0, -5.0), "epoch": 2016.0}
    whole = matches_from_table(table, ReadOptions(**options))
    stored = open_matches(tmp_path / "gaia.parquet", batch_rows=100, **options).load()
    # parallax factors are those of the middle of a batch
    np.testing.assert_allclose(stored.rho_uv, whole.rho_uv, atol=1e-3)
    assert stored.rho_uv[0] != 0
