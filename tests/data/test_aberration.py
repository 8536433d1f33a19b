from __future__ import annotations

from pathlib import Path

import astropy.units as apu
import astropy.wcs
import numpy as np
import pytest
from astropy.coordinates import GCRS, CartesianRepresentation, SkyCoord, get_sun
from astropy.io import fits
from astropy.time import Time

from bayesdist.data.sky import velocity_aberration
from bayesdist.errors import InputError

TARGETS = [(5.655, -72.07), (271.0, 66.5), (120.0, 20.0), (300.0, -20.0)]


def local_scales(ra, dec, time, velocity, step=20 / 3600):
    """True over apparent area, and over apparent length in two directions, by astropy."""
    east = step / np.cos(np.radians(dec))
    true = SkyCoord([ra - east, ra + east, ra, ra], [dec, dec, dec - step, dec + step], unit="deg")
    seen = true.transform_to(
        GCRS(obstime=time, obsgeoloc=CartesianRepresentation([0, 0, 0], unit=apu.m),
             obsgeovel=CartesianRepresentation(velocity, unit=apu.km / apu.s))
    )  # fmt: skip
    pairs = ((0, 1), (2, 3))
    return [float(true[a].separation(true[b]) / seen[a].separation(seen[b])) for a, b in pairs]


@pytest.mark.parametrize("epoch", [2003.1, 2008.4, 2013.8])
@pytest.mark.parametrize("target", TARGETS)
def test_the_factor_is_the_local_scale_of_the_sky_that_astropy_aberrates(epoch, target):
    time = Time(epoch, format="decimalyear", scale="tt")
    # what remains: the true direction for the apparent one, (v/c)^2 or 1e-8, and the deflection of
    # light by the Sun, 4.07 mas cot(angle / 2), which changes scales by 1.97e-8 / (1 - cos angle)
    angle = get_sun(time).separation(SkyCoord(*target, unit="deg"), origin_mismatch="ignore")
    allowed = 1.2e-8 + 2.0e-8 / (1.0 - np.cos(angle.rad))
    for velocity in ((0.0, 0.0, 0.0), (3.0, -5.0, 4.5)):
        factor = velocity_aberration(epoch, *target, velocity_km_s=velocity)
        found = local_scales(*target, time, velocity)
        np.testing.assert_allclose(found, factor, rtol=0, atol=allowed)


def test_the_orbit_of_hst_adds_up_to_25_millionths():
    n = np.array([np.cos(np.radians(-72.07)), 0.0, np.sin(np.radians(-72.07))])
    still = velocity_aberration(2005.2, 0.0, -72.07)
    ahead = velocity_aberration(2005.2, 0.0, -72.07, velocity_km_s=7.5 * n)
    across = velocity_aberration(2005.2, 0.0, -72.07, velocity_km_s=(0.0, 7.5, 0.0))
    assert ahead - still == pytest.approx(7.5 / 299792.458, rel=1e-3)
    # across only the Doppler-like square counts: b . db is 2.5e-9
    assert abs(across - still) < 4e-9


def test_a_real_header_has_the_factor():
    # HST 10368, 47 Tuc, 2005-03-07; the velocity in the orbit, 7.5 km/s, is not in the header
    path = Path(astropy.wcs.__file__).parent / "tests" / "data" / "j94f05bgq_flt.fits"
    with fits.open(path) as hdus:
        primary, science = hdus[0].header, hdus["SCI", 1].header
        time = Time(primary["EXPSTART"], format="mjd", scale="utc")
        ours = velocity_aberration(time, primary["RA_TARG"], primary["DEC_TARG"])
        assert abs(ours - science["VAFACTOR"]) < 2.6e-5
        # half a year later the motion of the Earth has turned round: it is no small number that
        # agrees by chance
        later = velocity_aberration(time + 0.5 * apu.yr, primary["RA_TARG"], primary["DEC_TARG"])
    assert ours > 1.0 > later


def test_over_a_year_the_ecliptic_sees_one_part_in_ten_thousand_both_ways():
    epochs = 2010.0 + np.arange(36) / 36
    factors = np.array([velocity_aberration(t, 0.0, 0.0) for t in epochs]) - 1.0
    # 29.78 km/s / c = 9.93e-5, times the eccentricity's 1.7 %
    assert factors.max() == pytest.approx(9.93e-5, rel=0.03)
    assert factors.min() == pytest.approx(-9.93e-5, rel=0.03)
    # at the pole of the ecliptic the Earth never comes nearer: eccentricity and b^2 only
    pole = [velocity_aberration(t, 270.0, 66.5607) - 1.0 for t in epochs[::6]]
    assert np.abs(pole).max() < 1e-7


def test_what_is_no_direction_or_velocity_is_refused():
    for arguments in ((np.nan, 1.0, 2.0), (2000.0, np.inf, 2.0), (2000.0, 1.0, 91.0)):
        with pytest.raises(InputError, match="no aberration"):
            velocity_aberration(*arguments)
    with pytest.raises(InputError, match="faster than light"):
        velocity_aberration(2000.0, 1.0, 2.0, velocity_km_s=(4e5, 0.0, 0.0))
