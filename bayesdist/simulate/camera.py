"""Simulated SExtractor catalogue of one exposure, matched to Gaia, with false matches."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from astropy.table import Table
    from astropy.wcs import WCS

SIZE = 2048  # pixels on each axis
SCALE = 0.2 / 3600  # degrees
EPOCH = 2024.3  # decimal year of the exposure
GAIA_EPOCH = 2016.0
FALSE = 0.02  # fraction of matches that are false


def camera() -> WCS:
    """WCS of the exposure: tangent plane at (150, 2) degrees with SIP distortion of order 3.

    The distortion is at most about 2 pixels.
    """
    from astropy.wcs import WCS, Sip

    a, b = np.zeros((4, 4)), np.zeros((4, 4))
    a[2, 0], a[1, 1], a[3, 0], a[1, 2] = 4e-7, -2e-7, 9e-10, 8e-10
    b[0, 2], b[1, 1], b[0, 3], b[2, 1] = -3e-7, 3e-7, 8e-10, 9e-10
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = "RA---TAN-SIP", "DEC--TAN-SIP"
    wcs.wcs.crval, wcs.wcs.crpix = (150.0, 2.0), ((SIZE + 1) / 2, (SIZE + 1) / 2)
    wcs.wcs.cd = [[-SCALE, 0.0], [0.0, SCALE]]
    wcs.sip = Sip(a, b, None, None, wcs.wcs.crpix)
    wcs.wcs.set()
    return wcs


def matched_to_gaia(n: int, rng: np.random.Generator) -> Table:
    """Table of n matched stars of one exposure, with centroid errors that depend on magnitude.

    The columns have the names and units of SExtractor and of the Gaia archive.  ALPHA_J2000 and
    DELTA_J2000 of SExtractor are omitted, since they are not reference positions.
    """
    from astropy.table import Table

    x, y = rng.uniform(0.5, SIZE + 0.5, (2, n))
    gaia = 21.0 - rng.exponential(1.5, n).clip(0, 7)
    centroid = np.hypot(0.01, 0.003 * 10 ** (0.3 * (gaia - 16.0)))
    # SExtractor counts pixels from 1, astropy from 0
    sky = camera().pixel_to_world(x - 1, y - 1)
    motion = rng.normal(0.0, 3.0, (2, n))  # mas / yr
    error = 0.03 * 10 ** (0.2 * (gaia - 16.0)).clip(0.7)  # mas
    years = EPOCH - GAIA_EPOCH
    cos = np.cos(sky.dec.radian)
    ra, dec = sky.ra.degree, sky.dec.degree
    x, y = x + centroid * rng.normal(size=n), y + centroid * rng.normal(size=n)
    false = rng.random(n) < FALSE
    x[false] += rng.normal(0.0, 2.0, false.sum())
    y[false] += rng.normal(0.0, 2.0, false.sum())
    x, y = (np.clip(z, 0.5, SIZE + 0.5) for z in (x, y))
    return Table(
        {
            "XWIN_IMAGE": x,
            "YWIN_IMAGE": y,
            "MAG_AUTO": gaia + rng.normal(0.0, 0.02, n),
            "ra": ra + (error * rng.normal(size=n) - years * motion[0]) / 3.6e6 / cos,
            "dec": dec + (error * rng.normal(size=n) - years * motion[1]) / 3.6e6,
            "ra_error": error,
            "dec_error": error,
            "pmra": motion[0],
            "pmdec": motion[1],
            "pmra_error": error,
            "pmdec_error": error,
            "ref_epoch": np.full(n, GAIA_EPOCH),
            "phot_g_mean_mag": gaia,
        }
    )
