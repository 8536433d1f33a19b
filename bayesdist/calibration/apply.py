"""Transformation between detector pixels and an undistorted output frame, with errors.

The forward transformation has four steps:

1. Pixels of subarrays are converted to pixels of the full chip, and the offset from the reference
   pixel is taken.
2. The polynomials give undistorted positions in arcseconds.
3. The positions are divided by the output scale (by default SCALE of the calibration).
4. The offset of the chip is added, so that all chips are in one image.

The inverse solves the forward transformation by Newton's method to rounding error.

Pixels of a subarray and of the full chip, both FITS 1-based, are related by the header keywords LTM
and LTV as in stwcs:

    image = LTM chip + LTV

CENTERA and SIZAXIS are not used.  They include the overscan, and calibration pipelines change
SIZAXIS but not CENTERA, so that for calibrated images they do not give the corner of the image.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike

from bayesdist.calibration.chip_map import ChipMap, chip_of
from bayesdist.calibration.inverse import detector_grid
from bayesdist.errors import FormatError, InputError
from bayesdist.utils.arrays import Bool, Float, Int

# points along each edge of a chip, since the edges are curved in the output frame
_EDGE = 257


@dataclass(frozen=True)
class OutputFrame:
    """Undistorted output image.

    Raises
    ------
    InputError
        If the scale or the velocity aberration factor is not positive, or the origin not finite.
    """

    scale: float  # size of an output pixel, in the calibration's unit (such as arcsec)
    origin: tuple[float, float] = (0.0, 0.0)  # output pixel of the calibration's zero point
    vafactor: float = 1.0  # velocity aberration factor by which positions are multiplied

    def __post_init__(self) -> None:
        for name, value in (("scale", self.scale), ("aberration factor", self.vafactor)):
            if not (np.isfinite(value) and value > 0):
                raise InputError(
                    f"the {name} is {value}", where="output frame", do="give a positive number"
                )
        if not np.isfinite(self.origin).all():
            raise InputError(
                f"the origin is {self.origin}", where="output frame", do="give finite numbers"
            )

    @property
    def pixels_per_unit(self) -> float:
        """Output pixels per unit of the calibration."""
        return self.vafactor / self.scale


@dataclass(frozen=True, eq=False)
class Positions:
    """Positions of N points, and their covariance due to the errors of the calibration."""

    x: Float  # (N,); NaN if there is no solution
    y: Float  # (N,)
    cov: Float | None  # (N, 2, 2); None if the calibration has no errors
    chip: Int  # (N,) chip number; 0 for positions outside of all chips

    @property
    def sigma_x(self) -> Float:
        """Standard deviations (N,) of x, in the unit of x; NaN if unknown."""
        return self._sigma(0)

    @property
    def sigma_y(self) -> Float:
        """Standard deviations (N,) of y, in the unit of y; NaN if unknown."""
        return self._sigma(1)

    @property
    def correlation(self) -> Float:
        """Correlation (N,) of x and y; 0 if one of them is exact, NaN if unknown."""
        if self.cov is None:
            return np.full(self.x.shape, np.nan)
        product = self.sigma_x * self.sigma_y
        ratio = np.divide(self.cov[:, 0, 1], product, out=np.zeros_like(product), where=product > 0)
        ratio[~np.isfinite(product)] = np.nan
        return np.clip(ratio, -1.0, 1.0)

    def _sigma(self, k: int) -> Float:
        if self.cov is None:
            return np.full(self.x.shape, np.nan)
        return np.sqrt(self.cov[:, k, k])


@dataclass(frozen=True, eq=False)
class Application:
    """Transformation between the pixels of several chips and an output frame."""

    chips: Mapping[int, ChipMap]  # by chip number, all in one plane
    frame: OutputFrame
    images: Mapping[int, Subarray] = field(default_factory=dict)  # subarrays, by chip number

    def forward(self, x: ArrayLike, y: ArrayLike, *, chip: int) -> Positions:
        """Transform pixels (N,) of a chip, or of its subarray, to output pixels.

        Pixels are FITS 1-based.  Raises InputError if the chip is unknown.
        """
        c, k = self.chip(chip), self.frame.pixels_per_unit
        x, y = self._image(chip).to_chip(np.atleast_1d(x), np.atleast_1d(y))
        at = k * c.at(x, y) + np.array(self.frame.origin)[:, None]
        cov = c.covariance_at(x, y)
        cov = None if cov is None else k**2 * cov
        return Positions(at[0], at[1], cov, np.full(x.size, chip))

    def inverse(self, X: ArrayLike, Y: ArrayLike, *, chip: int) -> Positions:
        """Transform output pixels (N,) to pixels of a chip, or of its subarray.

        The polynomials are extrapolated beyond the edges of the chip.  The result is NaN if
        Newton's method does not converge.  Raises InputError if the chip is unknown or its linear
        part is singular.
        """
        c, image = self.chip(chip), self._image(chip)
        pixels, slope = c.pixels(self.plane(X, Y))
        cov = c.covariance_at(*pixels)
        if cov is not None:
            back = np.array(image.ltm)[:, None] * np.linalg.inv(slope)
            cov = back @ cov @ np.swapaxes(back, 1, 2)
        number = np.where(np.isfinite(pixels[0]), chip, 0)
        return Positions(*image.from_chip(*pixels), cov, number)

    def locate(self, X: ArrayLike, Y: ArrayLike) -> Positions:
        """Transform output pixels (N,) to pixels of the chip that contains them.

        If chips overlap, the first one is used.  Positions in gaps or outside of all chips have NaN
        and chip 0.
        """
        X, Y = np.atleast_1d(np.asarray(X, float)), np.atleast_1d(np.asarray(Y, float))
        has_errors = all(c.cov is not None for c in self.chips.values())
        out = Positions(
            np.full(X.size, np.nan),
            np.full(X.size, np.nan),
            np.full((X.size, 2, 2), np.nan) if has_errors else None,
            np.zeros(X.size, np.int64),
        )
        for number, c in self.chips.items():
            pending = np.flatnonzero(out.chip == 0)
            candidates = self.inverse(X[pending], Y[pending], chip=number)
            on = on_chip(c, *self._image(number).to_chip(candidates.x, candidates.y))
            rows = pending[on]
            out.x[rows], out.y[rows], out.chip[rows] = candidates.x[on], candidates.y[on], number
            if out.cov is not None and candidates.cov is not None:
                out.cov[rows] = candidates.cov[on]
        return out

    def closure(self, chip: int) -> float:
        """Largest distance in pixels between a pixel and the inverse of its forward position."""
        x, y = detector_grid(self.chip(chip).basis.size)
        without_subarrays = replace(self, images={})
        at = without_subarrays.forward(x, y, chip=chip)
        back = without_subarrays.inverse(at.x, at.y, chip=chip)
        return float(np.hypot(back.x - x, back.y - y).max())

    def plane(self, X: ArrayLike, Y: ArrayLike) -> Float:
        """Positions (u, v), shape (2, N), of output pixels (N,), in the unit of the calibration."""
        at = np.stack([np.atleast_1d(np.asarray(v, float)) for v in (X, Y)])
        return (at - np.array(self.frame.origin)[:, None]) / self.frame.pixels_per_unit

    def chip(self, number: int) -> ChipMap:
        """Map of a chip; raises InputError if the chip is unknown."""
        return chip_of(self.chips, number, "application")

    def _image(self, chip: int) -> Subarray:
        return self.images.get(chip, FULL)


def frame_that_holds(
    chips: Mapping[int, ChipMap], scale: float, vafactor: float = 1.0
) -> tuple[OutputFrame, tuple[int, int]]:
    """Smallest output frame that contains all chips, and its numbers of columns and rows.

    `scale` and `vafactor` are those of `OutputFrame`.  The origin of the frame is a whole pixel.
    """
    plain = Application(chips, OutputFrame(scale, vafactor=vafactor))
    at = []
    for number, c in chips.items():
        x, y = (np.linspace(0.5, n + 0.5, _EDGE) for n in c.basis.size)
        ends = [np.full(_EDGE, v) for v in (x[0], x[-1], y[0], y[-1])]
        outline = plain.forward(
            np.concatenate([x, x, *ends[:2]]), np.concatenate([*ends[2:], y, y]), chip=number
        )
        at.append(np.stack([outline.x, outline.y]))
    low, high = np.concatenate(at, axis=1).min(axis=1), np.concatenate(at, axis=1).max(axis=1)
    origin = np.ceil(0.5 - low)
    size = np.ceil(high + origin - 0.5)
    frame = OutputFrame(scale, (float(origin[0]), float(origin[1])), vafactor)
    return frame, (int(size[0]), int(size[1]))


def on_chip(chip: ChipMap, x: Float, y: Float) -> Bool:
    """Boolean mask (N,) that is True for pixels on a chip, including its edges; False for NaN.

    x and y (N,) are FITS 1-based.
    """
    nx, ny = chip.basis.size
    return (x >= 0.5) & (x <= nx + 0.5) & (y >= 0.5) & (y <= ny + 0.5)


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
        """Convert pixels of the image to pixels of the chip, both FITS 1-based and of any shape."""
        return (
            (np.asarray(x, float) - self.ltv[0]) / self.ltm[0],
            (np.asarray(y, float) - self.ltv[1]) / self.ltm[1],
        )

    def from_chip(self, x: ArrayLike, y: ArrayLike) -> tuple[Float, Float]:
        """Convert pixels of the chip to pixels of the image, both FITS 1-based and of any shape."""
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
