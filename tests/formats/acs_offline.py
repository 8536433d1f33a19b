"""ACS/WFC exposures of our own choice, with all reference files, corrected by stwcs offline.

And the plane that stwcs makes of an IDCTAB, written down independently of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from astropy.wcs import WCS
from numpy.typing import NDArray

from .stwcs_offline import original_exposure, updated

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Pointing:
    """Where and when an exposure was taken."""

    date: str
    crval: tuple[float, float]
    pa_v3: float
    vafactor: float = 1.0
    filters: tuple[str, str] = ("F606W", "CLEAR2L")

    @property
    def epoch(self) -> float:
        """The date as stwcs counts it: year + day of the year / 365.25."""
        year, month, day = map(int, self.date.split("-"))
        days = np.datetime64(f"{year}-{month:02d}-{day:02d}") - np.datetime64(f"{year}-01-01")
        return year + (days.astype(int) + 1) / 365.25


def corrected(
    folder: Path,
    name: str,
    pointing: Pointing,
    *,
    idctab: Path,
    d2im: Path | None = None,
    npol: Path | None = None,
) -> dict[int, WCS]:
    """HSTWCS of each chip, by chip number."""
    files = {"D2IMFILE": d2im, "NPOLFILE": npol}
    hdus = original_exposure(
        idctab,
        pointing.date,
        FILTER1=pointing.filters[0],
        FILTER2=pointing.filters[1],
        PA_V3=pointing.pa_v3,
        **{keyword: file for keyword, file in files.items() if file is not None},
    )
    for hdu in hdus[1:]:
        hdu.header["CRVAL1"], hdu.header["CRVAL2"] = pointing.crval
        hdu.header["VAFACTOR"] = pointing.vafactor
    return updated(hdus, folder / f"{name}_flt.fits")


def to_sky(V: Float, pointing: Pointing, v2v3: tuple[float, float]) -> Float:
    """Sky (N, 2), degrees, of (Xc, Yc) (N, 2), arcseconds from the reference point of chip 2.

    (xi, eta) = VAFACTOR M (Xc, Yc), M = [[cos, -sin], [-sin, -cos]] of the angle of V3 at the
    aperture, on the plane that touches the sky at CRVAL.
    """
    turn = plane_matrix(pointing, v2v3)
    xi, eta = np.deg2rad(pointing.vafactor * V @ turn.T / 3600).T
    ra0, dec0 = np.deg2rad(pointing.crval)
    rho = np.hypot(1.0, np.hypot(xi, eta))
    dec = np.arcsin((np.sin(dec0) + eta * np.cos(dec0)) / rho)
    ra = ra0 + np.arctan2(xi, np.cos(dec0) - eta * np.sin(dec0))
    return np.rad2deg(np.stack([ra % (2 * np.pi), dec], axis=1))


def plane_matrix(pointing: Pointing, v2v3: tuple[float, float]) -> Float:
    """From (Xc, Yc) of ACS/WFC to (xi, eta), without VAFACTOR.

    The roll at the aperture is taken from stwcs: it is the telescope's, not the calibration's.
    """
    pytest.importorskip("stwcs")  # not on Windows
    from stwcs.updatewcs.makewcs import troll

    angle = np.deg2rad(troll(pointing.pa_v3, pointing.crval[1], *v2v3))
    c, s = np.cos(angle), np.sin(angle)
    # parity (1, -1): V2 = Xc, V3 = -Yc; V3 lies at `angle` from north towards east
    return np.array([[c, -s], [-s, -c]])
