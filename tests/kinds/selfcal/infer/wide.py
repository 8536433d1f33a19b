"""A wide field seen by a known camera, its tangent planes by astropy.wcs."""

from __future__ import annotations

import numpy as np
from astropy.wcs import WCS

from bayesdist.data.detections import Detections

N, E, SIGMA = 4096, 12, 0.01
MIDDLE = (N + 1) / 2
ARCSEC = 19 * 60 / N  # of a pixel: a field of 19 minutes of arc
STEP_DEG = 8 / 60
RA, DEC = 150.0, 40.0


def tangent_plane(ra, dec, roll=0.0, scale=1.0):
    """Tangent plane at a direction, units of `scale` seconds of arc, x against right ascension."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = ["RA---TAN", "DEC--TAN"], [ra, dec]
    wcs.wcs.crpix = [0.0, 0.0]
    c, s = np.cos(roll), np.sin(roll)
    wcs.wcs.cd = scale / 3600 * np.array([[-c, s], [s, c]])
    return wcs


def on(wcs, sky):
    """Directions on a tangent plane."""
    return wcs.wcs_world2pix(sky, 1)


def camera(bends, x, y):
    """The true camera, in pixels on its own tangent plane."""
    X, Y = (x - MIDDLE) / (N / 2), (y - MIDDLE) / (N / 2)
    terms = np.stack([X**2, X * Y, Y**2, X**3, X**2 * Y, X * Y**2, Y**3])
    linear = [x - MIDDLE + 0.001 * (y - MIDDLE), 1.001 * (y - MIDDLE) - 0.001 * (x - MIDDLE)]
    return np.stack(linear, axis=-1) + (bends @ terms).T


def observed(seed, *, arcsec=ARCSEC, step_deg=STEP_DEG, n_stars=3000, n_exposures=E):
    """Detections with true star numbers, pointings on the sky, and the bends of the camera.

    `arcsec`: of a pixel. The sky has stars up to half a field beyond the largest step.
    """
    half = step_deg + 0.6 * N * arcsec / 3600
    rng = np.random.default_rng(seed)
    bends, rolls = (
        4.0 * rng.standard_normal((2, 7)),
        np.radians(np.resize([0, 60, 130], n_exposures)),
    )
    wide = np.array([1 / np.cos(np.radians(DEC)), 1.0])
    pointings = [RA, DEC] + step_deg * wide * rng.uniform(-1, 1, (n_exposures, 2))
    sky = [RA, DEC] + wide * rng.uniform(-half, half, (n_stars, 2))
    found = []
    for e, (at, roll) in enumerate(zip(pointings, rolls, strict=True)):
        plane = on(tangent_plane(*at, roll, arcsec), sky)
        near = np.flatnonzero((np.abs(plane) < 0.52 * N).all(axis=1))
        plane = plane[near]
        x, y = plane.T + MIDDLE
        for _ in range(20):
            left = plane - camera(bends, x, y)
            x, y = x + left[:, 0], y + left[:, 1]
        inside = (np.abs(x - MIDDLE) < N / 2) & (np.abs(y - MIDDLE) < N / 2)
        n = int(inside.sum())
        seen = (z[inside] + SIGMA * rng.standard_normal(n) for z in (x, y))
        found.append((*seen, np.full(n, e), near[inside]))
    x, y, exposure, star = (np.concatenate(parts) for parts in zip(*found, strict=True))
    names = tuple(f"e{e}" for e in range(n_exposures))
    detections = Detections(x, y, exposure, names, sigma=np.full(len(x), SIGMA), star=star)
    return detections, pointings, rolls, bends
