"""Pixels to the output frame and back, each way with the calibration's error.

The four steps of section 4.1.5 of the ACS handbook:

1. the offset of a pixel from the zero point of its chip, subarrays first brought to the whole chip;
2. undistorted positions in arcseconds by the polynomials;
3. these divided by the output scale, SCALE unless another is wanted;
4. the chip's own offset added, so that all chips lie in one image.

The inverse is Newton's method on the forward polynomials, exact to rounding.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.calibration.chip_map import ChipMap, chip_of
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.subarray import FULL, Subarray
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Bool, Float, Int

# Points along each edge of a chip, whose image bulges.
_EDGE = 257


@dataclass(frozen=True)
class OutputFrame:
    """Image without distortion; a scale or factor that is not positive is refused."""

    scale: float  # size of its pixels, in the calibration's unit (arcsec for an IDCTAB)
    origin: tuple[float, float] = (0.0, 0.0)  # pixel of the reference chip's zero point
    vafactor: float = 1.0  # velocity aberration, by which positions are stretched

    def __post_init__(self) -> None:
        for name, value in (("scale", self.scale), ("VAFACTOR", self.vafactor)):
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
        """Output pixels in one unit of the calibration."""
        return self.vafactor / self.scale


@dataclass(frozen=True, eq=False)
class Positions:
    """Positions (N,) and their covariance by the calibration."""

    x: Float  # NaN where there is none
    y: Float
    cov: Float | None  # (N, 2, 2); None where the calibration has no errors
    chip: Int  # 0 where a position lies on no chip

    @property
    def sigma_x(self) -> Float:
        """Standard deviations of x; NaN where they are not known."""
        return self._sigma(0)

    @property
    def sigma_y(self) -> Float:
        """Standard deviations of y; NaN where they are not known."""
        return self._sigma(1)

    @property
    def correlation(self) -> Float:
        """Correlation of x and y; 0 where one of them is exact."""
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
    """Chips and the frame that they are brought to; `images` are subarrays, by chip."""

    chips: Mapping[int, ChipMap]  # in one plane; the first one's zero point is the frame's origin
    frame: OutputFrame
    images: Mapping[int, Subarray] = field(default_factory=dict)

    def forward(self, x: ArrayLike, y: ArrayLike, *, chip: int) -> Positions:
        """Positions in output pixels of FITS 1-based pixels (N,) of a chip, or of its image.

        InputError for an unknown chip.
        """
        c, k = self.chip(chip), self.frame.pixels_per_unit
        x, y = self._image(chip).to_chip(np.atleast_1d(x), np.atleast_1d(y))
        at = k * c.at(x, y) + np.array(self.frame.origin)[:, None]
        cov = c.covariance_at(x, y)
        cov = None if cov is None else k**2 * cov
        return Positions(at[0], at[1], cov, np.full(x.size, chip))

    def inverse(self, X: ArrayLike, Y: ArrayLike, *, chip: int) -> Positions:
        """Pixels of one chip, or of its image, at output pixels (N,), by Newton's method.

        The polynomials are also followed beyond the chip's edges; NaN where no pixel was found.
        InputError for an unknown chip, or one whose linear part is singular.
        """
        c, image = self.chip(chip), self._image(chip)
        found, slope = c.pixels(self.plane(X, Y))
        cov = c.covariance_at(*found)
        if cov is not None:
            back = np.array(image.ltm)[:, None] * np.linalg.inv(slope)
            cov = back @ cov @ np.swapaxes(back, 1, 2)
        number = np.where(np.isfinite(found[0]), chip, 0)
        return Positions(*image.from_chip(*found), cov, number)

    def locate(self, X: ArrayLike, Y: ArrayLike) -> Positions:
        """Pixels at output pixels (N,) of the chip on which each lies, the first where several do.

        NaN and chip 0 for those in gaps and outside.
        """
        X, Y = np.atleast_1d(np.asarray(X, float)), np.atleast_1d(np.asarray(Y, float))
        known = all(c.cov is not None for c in self.chips.values())
        out = Positions(
            np.full(X.size, np.nan),
            np.full(X.size, np.nan),
            np.full((X.size, 2, 2), np.nan) if known else None,
            np.zeros(X.size, np.int64),
        )
        for number, c in self.chips.items():
            rest = np.flatnonzero(out.chip == 0)
            here = self.inverse(X[rest], Y[rest], chip=number)
            on = on_chip(c, *self._image(number).to_chip(here.x, here.y))
            found = rest[on]
            out.x[found], out.y[found], out.chip[found] = here.x[on], here.y[on], number
            if out.cov is not None and here.cov is not None:
                out.cov[found] = here.cov[on]
        return out

    def closure(self, chip: int) -> float:
        """Largest distance between a pixel and the `inverse` of its position, pixels."""
        x, y = detector_grid(self.chip(chip).basis.size)
        whole = replace(self, images={})
        at = whole.forward(x, y, chip=chip)
        back = whole.inverse(at.x, at.y, chip=chip)
        return float(np.hypot(back.x - x, back.y - y).max())

    def plane(self, X: ArrayLike, Y: ArrayLike) -> Float:
        """Positions (2, N) in the unit of the calibration."""
        at = np.stack([np.atleast_1d(np.asarray(v, float)) for v in (X, Y)])
        return (at - np.array(self.frame.origin)[:, None]) / self.frame.pixels_per_unit

    def chip(self, number: int) -> ChipMap:
        """Map of a chip; InputError for an unknown one."""
        return chip_of(self.chips, number, "application")

    def _image(self, chip: int) -> Subarray:
        return self.images.get(chip, FULL)


def frame_that_holds(
    chips: Mapping[int, ChipMap], scale: float, vafactor: float = 1.0
) -> tuple[OutputFrame, tuple[int, int]]:
    """Smallest image that holds all chips, its origin a whole pixel, and its columns and rows."""
    plain = Application(chips, OutputFrame(scale, vafactor=vafactor))
    at = []
    for number, c in chips.items():
        x, y = (np.linspace(0.5, n + 0.5, _EDGE) for n in c.basis.size)
        ends = [np.full(_EDGE, v) for v in (x[0], x[-1], y[0], y[-1])]
        here = plain.forward(
            np.concatenate([x, x, *ends[:2]]), np.concatenate([*ends[2:], y, y]), chip=number
        )
        at.append(np.stack([here.x, here.y]))
    low, high = np.concatenate(at, axis=1).min(axis=1), np.concatenate(at, axis=1).max(axis=1)
    origin = np.ceil(0.5 - low)
    size = np.ceil(high + origin - 0.5)
    frame = OutputFrame(scale, (float(origin[0]), float(origin[1])), vafactor)
    return frame, (int(size[0]), int(size[1]))


def on_chip(chip: ChipMap, x: Float, y: Float) -> Bool:
    """Boolean mask of pixels on a chip, edges included; False for NaN."""
    nx, ny = chip.basis.size
    return (x >= 0.5) & (x <= nx + 0.5) & (y >= 0.5) & (y <= ny + 0.5)
