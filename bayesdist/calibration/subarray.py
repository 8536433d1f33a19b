"""Subarrays: their pixels, and those of the whole chip that a distortion is for.

    image = LTM chip + LTV

in FITS 1-based pixels, which is how stwcs, too, brings an image to its chip.  CENTERA and SIZAXIS
are not read: they count overscan, and calibration changes SIZAXIS but not CENTERA, so that in
calibrated images their corner is no longer that of the image.
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

    ltv: tuple[float, float] = (0.0, 0.0)  # LTV1, LTV2: pixel of the image less that of the chip
    ltm: tuple[float, float] = (1.0, 1.0)  # LTM1_1, LTM2_2: image pixels per chip pixel
    size: tuple[int, int] | None = None  # columns and rows of the image

    def __post_init__(self) -> None:
        if not (np.isfinite([*self.ltv, *self.ltm]).all() and min(self.ltm) > 0):
            raise InputError(
                f"LTV is {self.ltv} and LTM {self.ltm}",
                where="subarray",
                do="give finite numbers, and LTM above zero",
            )

    def to_chip(self, x: ArrayLike, y: ArrayLike) -> tuple[Float, Float]:
        """Pixels of the image to pixels of the chip, FITS 1-based both."""
        return (
            (np.asarray(x, float) - self.ltv[0]) / self.ltm[0],
            (np.asarray(y, float) - self.ltv[1]) / self.ltm[1],
        )

    def from_chip(self, x: ArrayLike, y: ArrayLike) -> tuple[Float, Float]:
        """Pixels of the chip to pixels of the image."""
        return (
            np.asarray(x, float) * self.ltm[0] + self.ltv[0],
            np.asarray(y, float) * self.ltm[1] + self.ltv[1],
        )


FULL = Subarray()


def subarray_at_corner(x: float, y: float) -> Subarray:
    """Subarray whose first pixel is pixel (x, y) of the chip, FITS 1-based."""
    return Subarray((1.0 - x, 1.0 - y))


def subarray_of_header(
    header: fits.Header | Mapping[str, Any], size: tuple[float, float]
) -> Subarray:
    """Subarray of a calibrated image from the header of its extension.

    `size` is the columns and rows (XSIZE, YSIZE) that the distortion is defined for.  An image as
    large as that is the whole field of its distortion, whatever its LTV: so are those behind a
    polariser, whose own rows are for less than the chip.  InputError without LTV1 and LTV2, unless
    the image is as large as the chip.
    """
    found = tuple(int(header.get(f"NAXIS{k}", 0)) for k in (1, 2))
    given = (found[0], found[1]) if min(found) > 1 else None
    if given == (int(size[0]), int(size[1])):
        return Subarray(size=given)
    if "LTV1" not in header or "LTV2" not in header:
        raise InputError(
            f"has no LTV1, LTV2, and its {found[0]} x {found[1]} pixels are not the whole chip's "
            f"{size[0]:g} x {size[1]:g}",
            where="image header",
            do="give the first pixel by --corner",
        )
    return Subarray(
        (float(header["LTV1"]), float(header["LTV2"])),
        (float(header.get("LTM1_1", 1.0)), float(header.get("LTM2_2", 1.0))),
        given,
    )


def subarrays_of_image(
    headers: Iterable[fits.Header], sizes: Mapping[int, tuple[float, float]], name: str = "image"
) -> dict[int, Subarray]:
    """Subarrays of all extensions SCI of a calibrated image, by chip number (CCDCHIP).

    `sizes` is the columns and rows of each chip of the distortion.  InputError without such an
    extension, or as for `subarray_of_header`.
    """
    out = {}
    for header in headers:
        if str(header.get("EXTNAME", "")).strip().upper() != "SCI":
            continue
        chip = int(header.get("CCDCHIP", 1))
        if chip not in sizes:
            raise InputError(
                f"shows chip {chip}, which the distortion does not have",
                where=name,
                do=f"give an image of chip {' or '.join(map(str, sizes))}",
            )
        try:
            out[chip] = subarray_of_header(header, sizes[chip])
        except InputError as error:
            raise InputError(error.cause, where=f"{name}, chip {chip}", do=error.do) from None
    if not out:
        raise FormatError(
            "has no extension SCI", where=name, do="give a calibrated image (flt or flc)"
        )
    return out
