"""Parallax factors against astropy's own chain of frames."""

from __future__ import annotations

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import GCRS, Distance, SkyCoord
from astropy.time import Time

from bayesdist.data.sky import parallax_factors

EPOCHS = np.linspace(2010.0, 2011.9, 8)


@pytest.mark.parametrize(("ra", "dec"), [(270.0, 66.56), (17.5, -72.0), (100.0, 23.0)])
def test_a_near_star_is_displaced_so_from_one_far_away(ra, dec):
    """Aberration is the same for both, but for 1e-4 of the parallax."""
    found = parallax_factors(EPOCHS, ra, dec)
    parallax = 1.0 * u.mas
    for when, (east, north) in zip(EPOCHS, found, strict=True):
        frame = GCRS(obstime=Time(when, format="jyear", scale="tdb"))
        near, far = (
            SkyCoord(ra * u.deg, dec * u.deg, distance=Distance(parallax=p)).transform_to(frame)
            for p in (parallax, 1e-6 * parallax)
        )
        d_ra, d_dec = far.spherical_offsets_to(near)
        assert d_ra.to_value("mas") == pytest.approx(east, abs=1e-3)
        assert d_dec.to_value("mas") == pytest.approx(north, abs=1e-3)


def test_at_the_pole_of_the_ecliptic_it_is_the_earths_distance():
    found = parallax_factors(EPOCHS, 270.0, 66.5607)
    assert np.hypot(*found.T) == pytest.approx(
        np.ones(8), abs=0.027
    )  # 0.017 and the Sun's own 0.01
