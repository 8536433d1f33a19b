"""Pixel area maps: what counts of a flat-fielded image are multiplied by for point sources.

A map holds the area of each pixel on the sky over that of a corrected pixel, SCALE squared.  Flat
fields make the sky look even, which divides each pixel by its area; the map undoes this, so that
photometry agrees with that of drizzled images.  So are those of ACS, without velocity aberration.
Those of WFC3 are relative to the area at one pixel instead.

The image stands in the primary HDU for one chip, as the observatory's files have it, and in
extensions SCI, 1 and on for several, in the order of an exposure's own.  Standard deviations follow
as ERR.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from bayesdist.assess.area import pixel_areas
from bayesdist.assess.calibration import Calibration
from bayesdist.data.files import atomic_path
from bayesdist.errors import InputError
from bayesdist.products.subarray import FULL, Subarray

__all__ = ["PixelAreaMap", "pixel_area_map", "write_pam"]

Float = NDArray[np.float64]

_MAGNITUDES = 2.5 / np.log(10.0)


@dataclass(frozen=True, eq=False)
class PixelAreaMap:
    """Relative pixel areas of one image.

    Parameters
    ----------
    chip : int
    area : ndarray, shape (ny, nx)
        Over that of a corrected pixel.
    sigma : ndarray, shape (ny, nx), or None
        Standard deviation; None where the calibration has no errors.
    scale : float
        Size of the corrected pixel.
    unit : str
        Its unit, that of the calibration.
    image : Subarray
    epoch : float or None
        Decimal years.
    """

    chip: int
    area: Float
    sigma: Float | None
    scale: float
    unit: str
    image: Subarray
    epoch: float | None

    @property
    def magnitude(self) -> Float:
        """What the map adds to the magnitude of a point source, (ny, nx)."""
        return -2.5 * np.log10(self.area)

    @property
    def sigma_magnitude(self) -> Float | None:
        """Standard deviation of `magnitude`."""
        return None if self.sigma is None else _MAGNITUDES * self.sigma / self.area


def pixel_area_map(
    calibration: Calibration, scale: float, *, image: Subarray = FULL
) -> PixelAreaMap:
    """The pixel area map of a chip, or of a part of it.

    Parameters
    ----------
    calibration : Calibration
    scale : float
        Size of a corrected pixel, in the unit of the calibration.
    image : Subarray
        With its size, unless it is the whole chip.

    Returns
    -------
    PixelAreaMap

    Raises
    ------
    InputError
        For a scale that is not positive, or a subarray without size or beyond the chip.
    """
    chip = calibration.chip or 1
    where = f"pixel area map of chip {chip}"
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"the scale is {scale}", where=where, do="give a positive number")
    x, y = _pixels(calibration, image, where)
    area, sigma = pixel_areas(calibration, x, y)
    # a binned pixel covers several of the chip's, and so does a corrected one of its image
    norm = 1.0 / scale**2
    return PixelAreaMap(
        chip=chip,
        area=norm * area,
        sigma=None if sigma is None else norm * sigma,
        scale=scale,
        unit=calibration.unit,
        image=image,
        epoch=calibration.epoch,
    )


def _pixels(calibration: Calibration, image: Subarray, where: str) -> tuple[Float, Float]:
    """Pixels of the chip, columns and rows, that an image shows."""
    nx, ny = (int(n) for n in calibration.basis.size)
    if image.size is None and image != FULL:
        raise InputError("the size of the subarray is not known", where=where, do="give it")
    columns, rows = image.size or (nx, ny)
    x, _ = image.to_chip(np.arange(1, columns + 1), 1.0)
    _, y = image.to_chip(1.0, np.arange(1, rows + 1))
    if min(x[0], y[0]) < 0.5 or x[-1] > nx + 0.5 or y[-1] > ny + 0.5:
        raise InputError(
            f"the subarray goes from ({x[0]:g}, {y[0]:g}) to ({x[-1]:g}, {y[-1]:g}), and the chip "
            f"has {nx} x {ny} pixels",
            where=where,
            do="check LTV1 and LTV2, and that the image is a calibrated one without overscan",
        )
    return x, y


def write_pam(
    path: str | os.PathLike[str],
    maps: Sequence[PixelAreaMap],
    *,
    instrument: str = "",
    detector: str = "",
    source: str = "",
) -> None:
    """Write pixel area maps of an image, whole or not at all.

    Parameters
    ----------
    path : path-like
    maps : sequence of PixelAreaMap
        One for each chip, in the order of the exposure's extensions.
    instrument, detector : str
        INSTRUME and DETECTOR; left out where empty.
    source : str
        The calibration, for the header.

    Raises
    ------
    InputError
        Without maps, or when the file cannot be written.
    """
    if not maps:
        raise InputError("there is no map to write", where=str(path), do="give one for each chip")
    primary = fits.PrimaryHDU()
    hdus: list[fits.PrimaryHDU | fits.ImageHDU] = [primary]
    for version, one in enumerate(maps, start=1):
        planes = [("SCI", one.area), ("ERR", one.sigma)]
        for name, values in planes:
            if values is None:
                continue
            data = values.astype(np.float32)
            if len(maps) == 1 and name == "SCI":
                primary.data = data
                _describe(primary.header, one)
                continue
            hdu = fits.ImageHDU(data, name=name)
            hdu.header["EXTVER"] = version
            _describe(hdu.header, one)
            hdus.append(hdu)
    for keyword, text in (("INSTRUME", instrument), ("DETECTOR", detector)):
        if text:
            primary.header[keyword] = text
    primary.header["FILETYPE"] = "PIXEL AREA MAP"
    primary.header["CREATOR"] = "bayesdist"
    if source:
        primary.header["BDSOURCE"] = (os.path.basename(source)[:60], "the calibration")
    with atomic_path(path) as temporary:
        fits.HDUList(hdus).writeto(temporary, checksum=True)


def _describe(header: fits.Header, one: PixelAreaMap) -> None:
    header["CCDCHIP"] = (one.chip, "chip number")
    header["PAMSCALE"] = (one.scale, f"[{one.unit}] pixel whose area counts as 1")
    for k, (ltv, ltm) in enumerate(zip(one.image.ltv, one.image.ltm, strict=True), start=1):
        header[f"LTV{k}"] = (ltv, "pixel of this image less that of the chip")
        header[f"LTM{k}_{k}"] = ltm
    if one.epoch is not None:
        header["EPOCH"] = (one.epoch, "[yr] date of the distortion")
