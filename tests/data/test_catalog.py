from __future__ import annotations

import astropy.units as apu
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import Table

from bayesdist.data import ReferenceCatalog, catalog_from_table, read_catalog, tangent_plane
from bayesdist.data.covariances import covariances_of
from bayesdist.data.sky import parallax_factors
from bayesdist.errors import InputError


def test_propagation_is_linear_in_time_and_quadratic_in_variance():
    c = ReferenceCatalog(
        u=[1.0, 2.0], v=[3.0, 4.0], sigma_u=[0.3, 0.3], sigma_v=[0.0, 0.1],
        pm_u=[0.1, -0.2], pm_v=[0.0, 1.0], sigma_pm_u=[0.1, 0.0], sigma_pm_v=[0.2, 0.0],
        epoch=np.array([2015.5, 2016.0]),
    )  # fmt: skip
    later = c.at(2019.5)
    np.testing.assert_allclose(later.u, [1.4, 1.3])
    np.testing.assert_allclose(later.v, [3.0, 7.5])
    np.testing.assert_allclose(later.sigma_u, [0.5, 0.3])  # 3-4-5
    np.testing.assert_allclose(later.sigma_v, [0.8, 0.1])
    assert later.epoch == 2019.5
    # two steps of positions are one
    np.testing.assert_allclose(c.at(2000.0).at(2019.5).u, later.u)
    assert c.u.tolist() == [1.0, 2.0]


GAIA = ("ra", "dec", "parallax", "pmra", "pmdec")


def with_correlations(rng, n=60, point=(150.0, 70.0)):
    """A table like Gaia's with all correlations, and its covariances (N, 5, 5), in mas."""
    root = rng.standard_normal((n, 5, 5))
    C = root @ np.swapaxes(root, 1, 2) + 0.01 * np.eye(5)
    sigma = np.sqrt(np.einsum("nii->ni", C))
    t = Table({"ra": point[0] + rng.uniform(-1, 1, n), "dec": point[1] + rng.uniform(-0.5, 0.5, n)})
    t["ra"].unit = t["dec"].unit = "deg"
    for k, (name, unit) in enumerate(zip(GAIA, ["mas"] * 3 + ["mas/yr"] * 2, strict=True)):
        t[f"{name}_error"] = sigma[:, k]
        t[f"{name}_error"].unit = unit
        if k > 1:
            t[name] = rng.normal(0.0, 5.0, n)
            t[name].unit = unit
        for j in range(k):
            t[f"{GAIA[j]}_{name}_corr"] = C[:, j, k] / (sigma[:, j] * sigma[:, k])
    return t, C


def plane_axes(ra, dec, point):
    """Derivatives (N, 2, 2) of the plane by east and north, by differences of astropy."""
    origin = SkyCoord(*point, unit="deg")
    frame = origin.skyoffset_frame()

    def on_plane(sky):
        at = sky.transform_to(frame)
        lon, lat = at.lon.rad, at.lat.rad
        return np.array([np.tan(lon), np.tan(lat) / np.cos(lon)])

    sky, step = SkyCoord(ra, dec, unit="deg"), 1e-6
    out = [
        (on_plane(sky.directional_offset_by(angle * apu.deg, step * apu.rad)) - on_plane(sky))
        / step
        for angle in (90.0, 0.0)
    ]
    return np.moveaxis(np.array(out), (0, 1, 2), (2, 1, 0))


def test_correlated_errors_come_to_the_epoch_on_the_plane(rng):
    """A C A^T, far from the tangent point and close to the pole, where the axes are turned."""
    point = (150.0, 70.0)
    t, C = with_correlations(rng)
    c = catalog_from_table(t, epoch=2016.0, tangent_point=point)
    axes = plane_axes(t["ra"], t["dec"], point)
    assert np.abs(axes[:, 0, 1]).max() > 0.01
    T = np.tile(np.eye(5), (len(t), 1, 1))
    T[:, :2, :2] = T[:, 3:, 3:] = axes
    on_plane = T @ C @ np.swapaxes(T, 1, 2) * 1e-6  # arcsec
    scale = np.abs(on_plane).max()
    np.testing.assert_allclose(c.covariances, on_plane, atol=1e-5 * scale)
    for epoch in (2004.3, 2031.7):
        east, north = parallax_factors(epoch, *point)[0]
        dt = epoch - 2016.0
        A = np.array([[1, 0, east, dt, 0], [0, 1, north, 0, dt]])
        expected = A @ on_plane @ A.T
        seen = c.as_seen(epoch)
        found = covariances_of(**renamed(seen.position_errors))
        np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
        # in two steps, and of the mirror image
        twice = c.at(1990.0).as_seen(epoch)
        np.testing.assert_allclose(twice.covariances, seen.covariances, atol=1e-12)
        mirrored = covariances_of(**renamed(seen.mirrored().position_errors))
        sign = np.array([[1, -1], [-1, 1]])
        np.testing.assert_allclose(mirrored, sign * found)
    some = c.select(np.array([5, 2])).rescaled(1000.0, "mas")
    np.testing.assert_allclose(some.covariances, 1e6 * c.covariances[[5, 2]])


def renamed(errors):
    return {"sigma_u": errors["sigma_u"], "sigma_v": errors["sigma_v"], "rho": errors["rho_uv"]}


def test_errors_of_parallaxes_are_common_to_both_axes():
    """Without any correlation of the catalogue: an error of the parallax moves along one line."""
    c = ReferenceCatalog(
        u=[0.0], v=[0.0], sigma_u=[1e-6], sigma_v=[1e-6], pm_u=[0.0], pm_v=[0.0], epoch=2016.0,
        parallax=[0.1], sigma_parallax=[0.01], unit="arcsec", tangent_point=(40.0, 35.0),
    )  # fmt: skip
    seen = c.as_seen(2016.3)
    factors = parallax_factors(2016.3, 40.0, 35.0)[0]
    assert seen.position_errors["rho_uv"][0] == pytest.approx(np.sign(factors.prod()), abs=1e-4)


def test_wrong_correlations_are_named(rng):
    t, _ = with_correlations(rng, 4)
    t["ra_dec_corr"][2] = 1.2
    with pytest.raises(InputError, match=r"row 3, column 'ra_dec_corr'.*a correlation is 1.2"):
        catalog_from_table(t, epoch=2016.0)
    t["ra_dec_corr"], t["ra_pmra_corr"], t["dec_pmra_corr"] = 0.9, 0.9, -0.9
    with pytest.raises(InputError, match="contradict each other"):
        catalog_from_table(t, epoch=2016.0)
    t = Table({"u": [0.0, 1.0], "v": [0.0, 1.0], "sigma_u": [1.0, 1.0], "sigma_v": [2.0, 2.0]})
    t["rho_uv"] = [0.5, -0.7]
    assert catalog_from_table(t, unit="pix").position_errors["rho_uv"].tolist() == [0.5, -0.7]
    t["rho_uv"] = [0.5, -1.7]
    with pytest.raises(InputError, match="row 2, column 'rho_uv'"):
        catalog_from_table(t, unit="pix")
    errors = {"sigma_u": [1.0], "sigma_v": [1.0]}
    with pytest.raises(InputError, match="1 matrices of 5 x 5"):
        ReferenceCatalog(u=[1.0], v=[1.0], **errors, correlations=np.ones((1, 2, 2)))
    with pytest.raises(InputError, match="correlations of errors but no errors"):
        ReferenceCatalog(u=[1.0], v=[1.0], correlations=np.ones((1, 5, 5)))


def test_stars_without_motions_stand_still():
    c = ReferenceCatalog(u=[1.0], v=[2.0]).at(2030.0)
    assert c.u.tolist() == [1.0] and c.sigma_u is None


def test_motions_need_an_epoch():
    c = ReferenceCatalog(u=[1.0], v=[2.0], pm_u=[1.0], pm_v=[1.0])
    with pytest.raises(InputError, match="no epoch"):
        c.at(2000.0)


def test_bad_catalogues_are_named():
    with pytest.raises(InputError, match="row 2, column 'v'"):
        ReferenceCatalog(u=[1.0, 2.0], v=[1.0, np.nan])
    with pytest.raises(InputError, match="'pm_v' is given without its partner"):
        ReferenceCatalog(u=[1.0], v=[1.0], pm_u=[1.0])
    with pytest.raises(InputError, match="not negative"):
        ReferenceCatalog(u=[1.0], v=[1.0], sigma_u=[-1.0], sigma_v=[1.0])
    with pytest.raises(InputError, match="no stars"):
        ReferenceCatalog(u=[], v=[])


@pytest.mark.parametrize("axes", [("xi", "eta"), ("u", "v")])
@pytest.mark.parametrize("form", ["{}_error", "{}_err", "sigma_{}", "e_{}"])
def test_errors_have_the_names_of_those_of_matches(axes, form):
    """As those of a table of matches; the errors of 2 and 3 mas are in arcsec."""
    if (axes[0], form) == ("u", "{}_error"):
        form = "{}_sigma"
    table = Table({name: [0.0, 5.0] for name in axes})
    for name, error in zip(axes, (2.0, 3.0), strict=True):
        table[name].unit = "arcsec"
        table[form.format(name)] = [error, 2 * error] * apu.mas
    catalogue = catalog_from_table(table)
    assert catalogue.sigma_u == pytest.approx([0.002, 0.004])
    assert catalogue.sigma_v == pytest.approx([0.003, 0.006])


def test_errors_on_one_axis_are_refused():
    table = Table({"xi": [0.0, 5.0], "eta": [0.0, 1.0], "xi_error": [0.1, 0.1]})
    with pytest.raises(InputError, match="'sigma_v' is given without its partner"):
        catalog_from_table(table, unit="arcsec")


def test_motions_on_the_sky_are_those_of_astropy(rng):
    n = 40
    t = Table({"ra": 271.0 + rng.uniform(-1, 1, n), "dec": -60 + rng.uniform(-1, 1, n)})
    t["pmra"], t["pmdec"] = rng.normal(0, 50, (2, n))
    t["pmra"].unit = t["pmdec"].unit = "mas / yr"
    c = catalog_from_table(t, epoch=2015.5, tangent_point=(271.0, -60.0))
    then = SkyCoord(
        t["ra"] * apu.deg, t["dec"] * apu.deg, distance=1000 * apu.pc,
        pm_ra_cosdec=t["pmra"].quantity, pm_dec=t["pmdec"].quantity,
    ).apply_space_motion(dt=10 * apu.yr)  # fmt: skip
    xi, eta = tangent_plane(then.ra.deg, then.dec.deg, (271.0, -60.0))
    moved = c.at(2025.5)
    # 0.5 arcsec of motion, to second order of the angles
    np.testing.assert_allclose([moved.u, moved.v], [xi, eta], rtol=0, atol=3e-5)
    assert c.unit == "arcsec" and np.ptp(moved.u - c.u) > 1.0


def test_motions_on_the_sky_need_their_unit():
    t = Table({"ra": [1.0], "dec": [1.0], "pmra": [3.0], "pmdec": [3.0]})
    with pytest.raises(InputError, match="column 'pmra': has no unit"):
        catalog_from_table(t)


def test_the_gaia_extract(data_dir):
    c = read_catalog(data_dir / "flystar" / "my_gaia.fits", unit="arcsec")
    # stars with two parameters have no parallax, and 0 in the columns of motions and their errors
    parallax = Table.read(data_dir / "flystar" / "my_gaia.fits")["parallax"]
    np.testing.assert_array_equal(c.assumed_motion, parallax.mask)
    assert len(c) == 815 and np.count_nonzero(parallax.mask) == 309
    assert np.all(c.epoch == 2015.5) and c.pm_u is not None
    assert "309 of 815 rows have no motion" in c.notes[0]
    assert c.sigma_pm_u[c.assumed_motion].min() > 1e-3 > np.median(c.sigma_pm_u[~c.assumed_motion])
    with pytest.raises(InputError, match="has no unit"):
        read_catalog(data_dir / "flystar" / "my_gaia.fits")
