"""Parallax factors: by how much a star of unit parallax is displaced at a date."""

from __future__ import annotations

import numpy as np
from astropy.coordinates import get_body_barycentric
from astropy.time import Time
from numpy.typing import ArrayLike, NDArray

__all__ = ["parallax_factors"]

Float = NDArray[np.float64]


def parallax_factors(epoch: ArrayLike, ra: float, dec: float) -> Float:
    """Displacement towards east and north per unit of parallax, seen from the Earth.

    A satellite in low orbit is within 5e-5 au of its centre.

    Parameters
    ----------
    epoch : array_like, shape (E,)
        Decimal (Julian) years.
    ra, dec : float
        Degrees, ICRS.

    Returns
    -------
    ndarray, shape (E, 2)

    Notes
    -----
    Green, Spherical Astronomy (1985), section 8; the Earth's place by astropy's own ephemeris
    (ERFA's epv00), which needs no file.
    """
    time = Time(np.atleast_1d(np.asarray(epoch, float)), format="jyear", scale="tdb")
    earth = get_body_barycentric("earth", time, ephemeris="builtin").xyz.to_value("au")
    a, d = np.radians([ra, dec])
    east = np.array([-np.sin(a), np.cos(a), 0.0])
    north = np.array([-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)])
    return -np.stack([east @ earth, north @ earth], axis=1)
