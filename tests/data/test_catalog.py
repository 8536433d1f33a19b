from __future__ import annotations

import astropy.units as apu
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import Table

from bayesdist.data import ReferenceCatalog, catalog_from_table, read_catalog, tangent_plane
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
    with pytest.raises(InputError, match="'pm_v' is missing beside its partner"):
        ReferenceCatalog(u=[1.0], v=[1.0], pm_u=[1.0])
    with pytest.raises(InputError, match="not negative"):
        ReferenceCatalog(u=[1.0], v=[1.0], sigma_u=[-1.0], sigma_v=[1.0])
    with pytest.raises(InputError, match="no stars"):
        ReferenceCatalog(u=[], v=[])


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
    assert len(c) == np.count_nonzero(~parallax.mask) == 506
    assert np.all(c.epoch == 2015.5) and c.pm_u is not None
    assert c.notes == ("309 stars are left out: proper motion of exactly 0",)
    with pytest.raises(InputError, match="has no unit"):
        read_catalog(data_dir / "flystar" / "my_gaia.fits")
