"""Effects of the Earth's motion on positions: parallax, and the scale of aberration.

    VAFACTOR = sqrt(1 - b^2) / (1 - n . b),    b = velocity / c

Stars are displaced towards the apex of the motion: a true offset on the sky is VAFACTOR times the
offset computed with an aberration-free pixel scale (Cox & Gilliland 2002, HST Calibration
Workshop). Aberration is conformal, so the factor is the same in all directions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float

if TYPE_CHECKING:
    from astropy.time import Time

_LIGHT = 299_792.458  # km/s


def velocity_aberration(
    epoch: float | Time,
    ra: float,
    dec: float,
    *,
    velocity_km_s: ArrayLike = (0.0, 0.0, 0.0),
) -> float:
    """Scale factor of velocity aberration for a target at an epoch.

    The barycentric velocity of the Earth is taken from astropy's built-in ephemeris, without
    network access. Over a year the factor varies by up to 1e-4; the orbit of HST (7.5 km/s) adds
    2.5e-5.

    Parameters
    ----------
    epoch : float or astropy Time
        Decimal year, or a time.
    ra, dec : float
        Position of the target in degrees. Strictly, the formula requires the apparent direction;
        the true direction changes the factor by b^2, 1e-8.
    velocity_km_s : array_like, shape (3,), optional
        Velocity of the telescope relative to the Earth, along the axes of the ICRS.

    Returns
    -------
    float
        VAFACTOR; larger than 1 if the telescope moves towards the target.

    Raises
    ------
    InputError
        If the epoch, direction or velocity is invalid.
    """
    import astropy.units as apu
    from astropy.coordinates import get_body_barycentric_posvel
    from astropy.time import Time

    relative = np.asarray(velocity_km_s, float)
    numbers = (0.0 if isinstance(epoch, Time) else float(epoch), float(ra), float(dec))
    if (
        relative.shape != (3,)
        or not np.isfinite([*relative, *numbers]).all()
        or abs(numbers[2]) > 90.0
    ):
        raise InputError(
            f"no aberration for epoch {epoch}, direction ({ra}, {dec}) and velocity {relative}",
            do="give a decimal year, ra and dec in degrees, and three components in km/s",
        )
    # TT needs no table of leap seconds, and an error of a minute changes the factor by only 1e-9
    time = epoch if isinstance(epoch, Time) else Time(epoch, format="decimalyear", scale="tt")
    _, earth = get_body_barycentric_posvel("earth", time, ephemeris="builtin")
    b = (earth.xyz.to_value(apu.km / apu.s) + relative) / _LIGHT
    speed2 = float(b @ b)
    if not speed2 < 1.0:
        raise InputError("the telescope is faster than light", do="give the velocity in km/s")
    a, d = np.radians([ra, dec])
    n = np.array([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)])
    return float(np.sqrt(1.0 - speed2) / (1.0 - n @ b))


def parallax_factors(epoch: ArrayLike, ra: float, dec: float) -> Float:
    """Displacements (E, 2) to east and north per unit of parallax, at Julian years (E,).

    `ra` and `dec` are ICRS degrees. The observer is at the centre of the Earth; a satellite in low
    orbit is within 5e-5 au of it. See Green, Spherical Astronomy (1985), section 8. The position of
    the Earth is from astropy's built-in ephemeris (ERFA's epv00), which needs no file.
    """
    from astropy.coordinates import get_body_barycentric
    from astropy.time import Time

    time = Time(np.atleast_1d(np.asarray(epoch, float)), format="jyear", scale="tdb")
    earth = get_body_barycentric("earth", time, ephemeris="builtin").xyz.to_value("au")
    a, d = np.radians([ra, dec])
    east = np.array([-np.sin(a), np.cos(a), 0.0])
    north = np.array([-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)])
    return -np.stack([east @ earth, north @ earth], axis=1)
