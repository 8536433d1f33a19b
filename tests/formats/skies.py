"""Positions on the sky by the programs that read headers, each from the text of one."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from bayesdist.calibration.calibration import Calibration
from bayesdist.data.tangent import sky_of_plane

__all__ = ["PROGRAMS", "apart_mas", "sky_by", "sky_of"]

PROGRAMS = ("astropy.wcs", "GalSim", "starlink-pyast")


def sky_by(program: str, header: fits.Header, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """RA and Dec (2, N), degrees, of pixels by one of PROGRAMS; skipped where it is missing."""
    if program == "astropy.wcs":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return np.asarray(WCS(header).all_pix2world(x, y, 1))
    if program == "GalSim":
        galsim = pytest.importorskip("galsim", reason="GalSim is not installed")
        wcs = galsim.GSFitsWCS(header=galsim.FitsHeader(header=header))
        # it works in place
        return np.degrees(np.asarray(wcs._radec(x.copy(), y.copy())))
    ast = pytest.importorskip("starlink.Ast", reason="starlink-pyast is not installed")
    frames = ast.FitsChan([card.image for card in header.cards]).read()
    return np.degrees(frames.tran([x, y], True))


def sky_of(found: Calibration, x: np.ndarray, y: np.ndarray, chip: int = 1) -> np.ndarray:
    """RA and Dec (2, N), degrees, of pixels by a calibration in arcsec on the sky."""
    assert found.plane.point is not None and found.unit == "arcsec"
    xi, eta = found.forward(x, y, chip=chip).T
    return np.stack(sky_of_plane(xi, eta, found.plane.point))


def apart_mas(a: np.ndarray, b: np.ndarray) -> float:
    """Largest distance of positions (2, N), degrees, in mas."""
    east = (a[0] - b[0] + 180) % 360 - 180
    return float(3.6e6 * np.hypot(east * np.cos(np.radians(a[1])), a[1] - b[1]).max())
