from __future__ import annotations

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS

from bayesdist.data import mean_direction, tangent_plane
from bayesdist.data.tangent import sky_of_plane, tangent_jacobian
from bayesdist.errors import InputError


@pytest.mark.parametrize("point", [(271.48, -30.34), (0.001, 72.0), (359.9, -5.0), (40.0, 90.0)])
def test_the_plane_is_that_of_astropy_wcs(point, rng):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = point
    wcs.wcs.lonpole = 180.0  # north stays up where the point is the pole itself
    wcs.wcs.cdelt = [1 / 3600, 1 / 3600]  # intermediate coordinates in seconds of arc
    xi, eta = rng.uniform(-4000, 4000, (2, 500))
    ra, dec = wcs.wcs_pix2world(xi, eta, 1)
    found = tangent_plane(ra, dec, point)
    np.testing.assert_allclose(found, [xi, eta], rtol=0, atol=1e-8)
    back = SkyCoord(*sky_of_plane(xi, eta, point), unit="deg")
    assert back.separation(SkyCoord(ra, dec, unit="deg")).arcsec.max() < 1e-8


def test_xi_grows_to_the_east_and_eta_to_the_north():
    xi, eta = tangent_plane([10.001, 10.0], [20.0, 20.001], (10.0, 20.0))
    assert xi[0] > 3 and abs(eta[0]) < 1e-3
    assert eta[1] == pytest.approx(3.6, rel=1e-6) and abs(xi[1]) < 1e-9


def test_the_jacobian_is_the_derivative(rng):
    ra, dec = 30 + rng.uniform(-2, 2, 50), 60 + rng.uniform(-2, 2, 50)
    point, h = (30.0, 60.0), 1e-5
    east, west = (tangent_plane(ra + s * h / np.cos(np.radians(dec)), dec, point) for s in (1, -1))
    north, south = (tangent_plane(ra, dec + s * h, point) for s in (1, -1))
    J = tangent_jacobian(ra, dec, point) * 3600
    np.testing.assert_allclose(J[:, :, 0].T, np.subtract(east, west) / (2 * h), atol=1e-3)
    np.testing.assert_allclose(J[:, :, 1].T, np.subtract(north, south) / (2 * h), atol=1e-3)


def test_the_mean_direction_knows_that_ra_is_a_circle():
    assert mean_direction([359.0, 1.0], [0.0, 0.0])[0] % 360 == pytest.approx(0.0, abs=1e-12)
    assert mean_direction([0, 90, 180, 270], [80, 80, 80, 80])[1] == pytest.approx(90.0)


def test_the_other_half_of_the_sky_has_no_place_on_the_plane():
    with pytest.raises(InputError, match=r"f\.fits, row 2: the position lies 90 degrees"):
        tangent_plane([10.0, 190.0], [0.0, 0.0], (10.0, 0.0), where="f.fits")
