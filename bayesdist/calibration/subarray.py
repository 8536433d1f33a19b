"""Subarrays: conversion between pixels of an image and pixels of the full chip.

    image = LTM chip + LTV

in FITS 1-based pixels, as in stwcs.  CENTERA and SIZAXIS are not used.  They include the overscan,
and calibration pipelines change SIZAXIS but not CENTERA, so that for calibrated images they do not
give the corner of the image.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike

from bayesdist.errors import FormatError, InputError
from bayesdist.utils.arrays import Float


@dataclass(frozen=True)
class Subarray:
    """Position of an image on its chip."""

    ltv: tuple[float, float] = (0.0, 0.0)  # LTV1, LTV2: offset of image pixels from chip pixels
    ltm: tuple[float, float] = (1.0, 1.0)  # LTM1_1, LTM2_2: image pixels per chip pixel
    size: tuple[int, int] | None = None  # columns and rows of the image

    def __post_init__(self) -> None:
        if not (np.isfinite([*self.ltv, *self.ltm]).all() and min(self.ltm) > 0):
            raise InputError(
                f"LTV is {self.ltv} and LTM {self.ltm}",
                where="subarray",
                do="give finite numbers and positive LTM",
            )

    def to_chip(self, x: ArrayLike, y: ArrayLike) -> tuple[Float, Float]:
        """Convert pixels of the image to pixels of the chip, both FITS 1-based."""
        return (
            (np.asarray(x, float) - self.ltv[0]) / self.ltm[0],
            (np.asarray(y, float) - self.ltv[1]) / self.ltm[1],
        )

    def from_chip(self, x: ArrayLike, y: ArrayLike) -> tuple[Float, Float]:
        """Convert pixels of the chip to pixels of the image, both FITS 1-based."""
        return (
            np.asarray(x, float) * self.ltm[0] + self.ltv[0],
            np.asarray(y, float) * self.ltm[1] + self.ltv[1],
        )


FULL = Subarray()


def subarray_at_corner(x: float, y: float) -> Subarray:
    """Subarray that begins at pixel (x, y) of the chip, FITS 1-based."""
    return Subarray((1.0 - x, 1.0 - y))


def subarray_of_header(
    header: fits.Header | Mapping[str, Any], size: tuple[float, float]
) -> Subarray:
    """Subarray of a calibrated image from the header of its extension.

    Parameters
    ----------
    header : astropy.io.fits.Header or mapping
        Header of the image extension.
    size : tuple of float
        Columns and rows (XSIZE, YSIZE) for which the distortion is defined.  An image of this size
        is taken as the full field of the distortion, and LTV is ignored.  This includes images with
        a polariser, for which the distortion covers only a part of the chip.

    Returns
    -------
    Subarray

    Raises
    ------
    InputError
        If the image has another size and LTV1 or LTV2 is missing.
    """
    naxis = tuple(int(header.get(f"NAXIS{k}", 0)) for k in (1, 2))
    image_size = (naxis[0], naxis[1]) if min(naxis) > 1 else None
    if image_size == (int(size[0]), int(size[1])):
        return Subarray(size=image_size)
    if "LTV1" not in header or "LTV2" not in header:
        raise InputError(
            f"has no LTV1, LTV2, and its {naxis[0]} x {naxis[1]} pixels are not the full chip's "
            f"{size[0]:g} x {size[1]:g}",
            where="image header",
            do="give the first pixel with --corner",
        )
    return Subarray(
        (float(header["LTV1"]), float(header["LTV2"])),
        (float(header.get("LTM1_1", 1.0)), float(header.get("LTM2_2", 1.0))),
        image_size,
    )


def subarrays_of_image(
    headers: Iterable[fits.Header], sizes: Mapping[int, tuple[float, float]], name: str = "image"
) -> dict[int, Subarray]:
    """Subarrays of all SCI extensions of a calibrated image, by chip number (CCDCHIP).

    `sizes` are the columns and rows of each chip of the distortion.  Raises InputError if there is
    no SCI extension, an extension has an unknown chip, or its subarray is unknown (see
    `subarray_of_header`).
    """
    out = {}
    for header in headers:
        if str(header.get("EXTNAME", "")).strip().upper() != "SCI":
            continue
        chip = int(header.get("CCDCHIP", 1))
        if chip not in sizes:
            raise InputError(
                f"shows chip {chip}, for which there is no distortion",
                where=name,
                do=f"give an image of chip {' or '.join(map(str, sizes))}",
            )
        try:
            out[chip] = subarray_of_header(header, sizes[chip])
        except InputError as error:
            raise InputError(error.cause, where=f"{name}, chip {chip}", do=error.do) from None
    if not out:
        raise FormatError(
            "has no SCI extension", where=name, do="give a calibrated image (flt or flc)"
        )
    return out
