"""Positions of pixels as the users of calibration files get them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS, FITSFixedWarning
from numpy.typing import NDArray

from bayesdist.data.tangent import tangent_plane
from bayesdist.model import LookupTable, corrected
from bayesdist.products import IdcTab, SipHeader, sip_header
from bayesdist.products.parity import parity_of
from bayesdist.products.sip_build import ARCSEC

__all__ = ["ReleasedSet", "sip_positions", "sky_of_header"]

Float = NDArray[np.float64]


def sip_positions(
    sip: SipHeader,
    x: Float,
    y: Float,
    *,
    unit: str,
    scale_arcsec: float | None,
    like: SipHeader | None = None,
    tangent_point: tuple[float, float] | None = None,
) -> Float:
    """(u, v) of pixels (N,) by the forward terms of a header, shape (N, 2).

    Parameters
    ----------
    sip : SipHeader
    x, y : ndarray, shape (N,)
        FITS 1-based pixels.
    unit : str
        Of u and v.
    scale_arcsec : float or None
        Arcseconds in a pixel, as the header was made with, for u and v in pixels.
    like : SipHeader, optional
        Whose CD and zero point hold, for a file that states neither.
    tangent_point : tuple of float, optional
        Sky position of u, v = 0: the way is then over the sky, as astropy.wcs has it.
    """
    if tangent_point is not None:
        plane = tangent_plane(*sky_of_header(sip_header(sip), x, y), tangent_point)
        return np.stack(plane, axis=-1) / ARCSEC[unit]
    stated = like or sip
    in_unit = 3600.0 / (ARCSEC[unit] if unit != "pix" else scale_arcsec or 1.0)
    offset = stated.offset or (0.0, 0.0)
    return np.stack(sip.forward(x, y), axis=-1) @ (in_unit * stated.cd).T + offset


def sky_of_header(header: fits.Header, x: Float, y: Float) -> tuple[Float, Float]:
    """RA and Dec (N,) in degrees of pixels by a header, as astropy.wcs has them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        ra, dec = WCS(header).all_pix2world(x, y, 1)
    return np.asarray(ra), np.asarray(dec)


@dataclass(frozen=True, eq=False)
class ReleasedSet:
    """An IDCTAB and the look-up tables that are used with it.

    Parameters
    ----------
    idctab : IdcTab
    d2im : sequence of LookupTable
        Added to pixels before the polynomial.
    npol : mapping of int to LookupTable
        By chip: added after it, in pixels of SCALE.
    filter : str, optional
    """

    idctab: IdcTab
    d2im: Sequence[LookupTable] = ()
    npol: Mapping[int, LookupTable] | None = None
    filter: str | None = None

    def __call__(self, x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        """Positions (N, 2) in arcseconds, all chips along the same axes."""
        tab = self.idctab
        px, py = corrected(self.d2im, x, y, chip=chip)
        at = np.stack(tab.evaluate(chip, px, py, filter=self.filter, epoch=epoch), axis=-1)
        record = tab.rows[tab.row(chip, self.filter)]
        if self.npol and chip in self.npol:
            at = at + round(float(record["SCALE"]), 8) * self.npol[chip].evaluate(px, py)
        parity = parity_of(tab.instrument, tab.detector)
        return np.asarray(at + np.multiply((record["V2REF"], record["V3REF"]), parity))

    def back(self, x: Float, y: Float, chip: int) -> Float:
        """How far (N, 2) INVERSE rows miss pixels that FORWARD ones have sent away, pixels."""
        there = self.idctab.evaluate(chip, x, y, filter=self.filter)
        back = self.idctab.invert(chip, *there, filter=self.filter)
        return np.stack([back[0] - x, back[1] - y], axis=-1)

    @property
    def has_inverse(self) -> bool:
        """Whether there are INVERSE rows."""
        names = self.idctab.columns
        return "DIRECTION" in names and any(
            str(d).strip().upper() == "INVERSE" for d in self.idctab.rows["DIRECTION"]
        )
