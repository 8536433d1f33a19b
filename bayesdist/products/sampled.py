"""Sample a header of any projection through astropy.wcs and fit a polynomial."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from astropy.io import fits

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import ChipMap, fitted_map
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.plane import Plane
from bayesdist.data.tangent import is_on_plane, separation, sky_of_plane, tangent_plane
from bayesdist.errors import InputError
from bayesdist.products.common.cards import holds_wcs
from bayesdist.products.common.celestial import image_size, projection_code, wcs_of
from bayesdist.products.common.content import Content, read_content
from bayesdist.products.common.document import required_size
from bayesdist.utils.arrays import Float

if TYPE_CHECKING:
    from astropy.wcs import WCS

FIRST_ORDER, LAST_ORDER = 2, 9  # orders that are tried
GOOD_PIX = 1e-3  # pixels; stop raising the order when the largest distance is below this
_GRID = 65  # points per axis at which the polynomial is compared with astropy.wcs


@dataclass(frozen=True, eq=False)
class SampledCalibration:
    """Polynomial on a tangent plane fitted to a header, and its distance from the header."""

    calibration: Calibration
    order: int
    largest_pix: float  # largest distance on the sky from astropy.wcs over the image, pixels
    rms_pix: float
    pixel_arcsec: float  # mean side of a pixel
    projection: str  # code of the header's projection
    system: str  # celestial system of the header; the calibration is in ICRS

    @property
    def sentence(self) -> str:
        """Sentence on the distance between the polynomial and the header."""
        mas = 1e3 * self.pixel_arcsec
        source = f"{self.projection}, {self.system.upper()}"
        return (
            f"sampled through astropy.wcs ({source}): a polynomial of "
            f"order {self.order} is {self.largest_pix:.2g} pix ({self.largest_pix * mas:.2g} mas) "
            f"from it at worst, {self.rms_pix:.2g} pix rms, on {_GRID} x {_GRID} pixels"
        )


def sampled_calibration(
    path: str | os.PathLike[str],
    *,
    order: int | None = None,
    size: tuple[float, float] | None = None,
) -> SampledCalibration:
    """Calibration of a header of any projection that astropy.wcs can read.

    Parameters
    ----------
    path : path-like
        FITS file, or text file of cards. Its first header with two celestial axes is used.
    order : int, optional
        Order of the polynomial. The default is the lowest order from 2 to 9 that agrees with the
        header to 0.001 pixels, or else the best of these orders.
    size : tuple of float, optional
        Columns and rows, for a header that does not state them.

    Returns
    -------
    SampledCalibration
        One chip without errors, in arcsec on the plane tangent to the sky (ICRS) at the reference
        pixel, or at the middle of the image if the reference pixel is outside the image.

    Raises
    ------
    InputError
        If the file has no celestial header, astropy.wcs cannot read it, or part of the image has no
        position on one tangent plane.
    """
    content = read_content(path)
    header, wcs = _celestial(content)
    stated = required_size(image_size(header), size, content.name)
    positions = _Positions.of(wcs, stated, content.name)
    tried = range(FIRST_ORDER, LAST_ORDER + 1) if order is None else (order,)
    best: tuple[float, float, ChipMap] | None = None
    for trial_order in tried:
        fitted = fitted_map(
            positions.plane,
            content.name,
            order=trial_order,
            size=stated,
            reference_pixel=positions.pixel,
            unit="arcsec",
        )
        largest, rms = positions.distances(fitted)
        if best is None or largest < best[0]:
            best = largest, rms, fitted
        if largest < GOOD_PIX * positions.pixel_arcsec:
            break
    if best is None:
        raise InputError("no order is given", where="--order", do="give an order of at least 1")
    largest, rms, fitted = best
    calibration = calibration_of_maps(
        {1: fitted},
        content.name,
        plane=Plane("sky", point=positions.point),
        numbered=False,
    )
    return SampledCalibration(
        calibration,
        fitted.basis.order,
        largest / positions.pixel_arcsec,
        rms / positions.pixel_arcsec,
        positions.pixel_arcsec,
        projection_code(header) or "TAN",
        positions.system,
    )


def _celestial(content: Content) -> tuple[fits.Header, WCS]:
    """First header with two celestial axes, and its WCS."""
    for hdu in content.hdus:
        if not (holds_wcs(hdu.header) or projection_code(hdu.header)):
            continue
        wcs = wcs_of(hdu.header, content.name, content.opened)
        if wcs.wcs.lng < 0 or wcs.wcs.lat < 0:
            continue
        if wcs.naxis != 2:
            raise InputError(
                f"has {wcs.naxis} axes, but only images with two celestial axes can be sampled",
                where=content.name,
                do="write the header of the two celestial axes: astropy.wcs.WCS(header).celestial",
            )
        return hdu.header, wcs
    raise InputError(
        "has no header with two celestial axes",
        where=content.name,
        do="leave out --sample, which requires a header that astropy.wcs reads",
    )


@dataclass(frozen=True, eq=False)
class _Positions:
    """Pixel positions computed by astropy.wcs, in ICRS and on a tangent plane."""

    wcs: WCS
    size: tuple[float, float]
    where: str
    pixel: tuple[float, float]  # tangent point in pixels
    point: tuple[float, float]  # RA and Dec of the tangent point, degrees
    pixel_arcsec: float
    system: str

    @classmethod
    def of(cls, wcs: WCS, size: tuple[float, float], where: str) -> _Positions:
        """Positions with the tangent point at the reference pixel, or else at the image centre."""
        from astropy.wcs.utils import wcs_to_celestial_frame

        try:
            system = wcs_to_celestial_frame(wcs).name
        except ValueError as error:
            raise InputError(
                "has a celestial system that astropy does not know",
                where=where,
                do="correct RADESYS or CTYPE",
            ) from error
        x, y = (float(z) for z in wcs.wcs.crpix)
        inside = 0.5 <= x <= size[0] + 0.5 and 0.5 <= y <= size[1] + 0.5
        pixel = (x, y) if inside else ((size[0] + 1) / 2, (size[1] + 1) / 2)
        bare = cls(wcs, size, where, pixel, (0.0, 0.0), 1.0, system)
        # offsets of one pixel along each axis
        ra, dec = bare.sky(pixel[0] + np.array([0.0, 1.0, 0.0]), pixel[1] + np.array([0.0, 0, 1]))
        point = float(ra[0]), float(dec[0])
        u, v = tangent_plane(ra, dec, point)
        area = abs((u[1] - u[0]) * (v[2] - v[0]) - (u[2] - u[0]) * (v[1] - v[0]))
        return cls(wcs, size, where, pixel, point, float(np.sqrt(area)), system)

    def sky(self, x: Float, y: Float) -> tuple[Float, Float]:
        """RA and Dec (N,) in ICRS, degrees, of FITS 1-based pixels."""
        from astropy.coordinates import SkyCoord
        from astropy.wcs.utils import wcs_to_celestial_frame

        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            world = np.asarray(self.wcs.all_pix2world(np.column_stack([x, y]), 1), float)
            lon, lat = world[:, self.wcs.wcs.lng], world[:, self.wcs.wcs.lat]
            finite = np.isfinite(lon) & np.isfinite(lat)
            if not finite.all():
                raise InputError(
                    f"has no position on the sky for {100 * np.mean(~finite):.2g} % of the image",
                    where=self.where,
                    do="cut the image where the projection ends, or give --size of a part",
                )
            units = tuple(self.wcs.wcs.cunit[k] for k in (self.wcs.wcs.lng, self.wcs.wcs.lat))
            frame = wcs_to_celestial_frame(self.wcs)
            at = SkyCoord(lon, lat, unit=units, frame=frame)
            if not hasattr(at, "icrs") or not at.is_transformable_to("icrs"):
                raise InputError(
                    f"has coordinates ({frame.name}) that cannot be transformed to ICRS",
                    where=self.where,
                    do="give a header of right ascension and declination",
                )
            icrs = at.icrs
        return np.asarray(icrs.ra.deg, float), np.asarray(icrs.dec.deg, float)

    def plane(self, x: Float, y: Float) -> Float:
        """Positions (2, N) on the tangent plane, arcsec."""
        ra, dec = self.sky(x, y)
        if not is_on_plane(ra, dec, self.point).all():
            raise InputError(
                "is wider than a tangent plane, which ends 90 degrees from its middle",
                where=self.where,
                do="give --size of a part of the image",
            )
        return np.stack(tangent_plane(ra, dec, self.point))

    def distances(self, one: ChipMap) -> tuple[float, float]:
        """Largest and rms distance of a polynomial from astropy.wcs on the sky, arcsec."""
        x, y = detector_grid(self.size, _GRID)
        u, v = one.at(x, y)
        far = 3600.0 * separation(sky_of_plane(u, v, self.point), *self.sky(x, y))
        return float(far.max()), float(np.sqrt(np.mean(far**2)))
