"""A detector of one or more chips as a single array, and its non-linear distortion.

Section 4.1 of the ACS handbook gives scales, angles and areas of whole detectors, and shows the
chips of the WFC as one array.  The non-linear distortion is defined as the residual from the best
linear map of the whole field.  With this definition the IDCTAB of the WFC gives the published
maximum.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike

from bayesdist.calibration.area import pixel_areas
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.errors import InputError
from bayesdist.model.grid import mesh
from bayesdist.utils.arrays import Float


@dataclass(frozen=True, eq=False)
class ChipField:
    """Non-linear part of the distortion on a grid of one chip."""

    chip: int
    x: Float  # (nx,), pixels of the detector as one array
    y: Float  # (ny,)
    du: Float  # (ny, nx), along the axes of the undistorted frame, output pixels
    dv: Float  # (ny, nx)
    along_x: Float  # (ny, nx), the same vectors along the axes of the detector, in its pixels
    along_y: Float  # (ny, nx)

    @property
    def length(self) -> Float:
        """Length (ny, nx) of the vectors, in output pixels."""
        return np.hypot(self.du, self.dv)


@dataclass(frozen=True, eq=False)
class WholeDetector:
    """Chips of a detector in one undistorted plane.

    Raises InputError if there are no chips, the scale is not positive, or a chip has no area.
    """

    # maps by chip number; pixels of the whole array are those of the first chip, extended
    chips: Mapping[int, ChipMap]
    scale: float  # size of an output pixel, in the unit of the maps

    def __post_init__(self) -> None:
        if not self.chips:
            raise InputError("the detector has no chip", do="give at least one")
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise InputError(
                f"the scale is {self.scale}", where="scale", do="give a positive number"
            )
        for c in self.chips.values():
            if not np.abs(np.linalg.det(c.slope(*_middle(c)))).min() > 0:
                raise InputError(
                    "has a singular linear part at its centre",
                    where=f"{c.name}, chip {c.chip}",
                    do="check its coefficients",
                )

    # -- the chips as one array -------------------------------------------------------------------

    @cached_property
    def places(self) -> dict[int, tuple[float, float]]:
        """Offsets (x, y) of pixels of the whole array from pixels of each chip, by chip number.

        The gap between two chips is the distance between their nearest edges in the undistorted
        plane, in units of their mean pixel scale.
        """
        first, *further_chips = self.chips
        out = {first: (0.0, 0.0)}
        a = self.chips[first]
        ax, ay = _edge_points(a)
        on_a = a.at(ax, ay)
        for number in further_chips:
            b = self.chips[number]
            bx, by = _edge_points(b)
            on_b = b.at(bx, by)
            far = np.hypot(*(on_a[:, :, None] - on_b[:, None, :]))
            i, j = np.unravel_index(int(far.argmin()), far.shape)
            mean = (a.slope(ax[[i]], ay[[i]]) + b.slope(bx[[j]], by[[j]]))[0] / 2
            gap = np.linalg.solve(mean, on_b[:, j] - on_a[:, i])
            out[number] = float(ax[i] + gap[0] - bx[j]), float(ay[i] + gap[1] - by[j])
        return out

    @cached_property
    def bounds(self) -> tuple[Float, Float]:
        """Lower left and upper right corner of the whole array, (2,) each."""
        low = np.min([np.array(p) + 0.5 for p in self.places.values()], axis=0)
        high = np.max(
            [np.array(p) + 0.5 + self.chips[n].basis.size for n, p in self.places.items()], axis=0
        )
        return low, high

    @property
    def centre(self) -> tuple[float, float]:
        """Centre of the whole array, in its pixels."""
        (low_x, low_y), (high_x, high_y) = self.bounds
        return float(low_x + high_x) / 2, float(low_y + high_y) / 2

    # -- the linear map ---------------------------------------------------------------------------

    @cached_property
    def linear(self) -> tuple[Float, Float]:
        """Best linear map from pixels of the whole array: values at its centre (2,), slope (2, 2).

        It is fitted by least squares over the area of all chips.  The integrals are exact because
        they are evaluated at Gauss-Legendre nodes.
        """
        design, values, weights = [], [], []
        for number, c in self.chips.items():
            nodes, q = legendre.leggauss(c.basis.order + 1)
            X, Y = mesh(nodes, nodes)
            (hx, hy), (nx, ny) = c.basis.half_size, c.basis.size
            x, y = X * hx + (nx + 1) / 2, Y * hy + (ny + 1) / 2
            design.append(self._design(number, x, y))
            values.append(c.at(x, y).T)
            weights.append(np.sqrt(np.outer(q, q).ravel() * hx * hy))
        w = np.concatenate(weights)[:, None]
        solution = np.linalg.lstsq(
            w * np.concatenate(design), w * np.concatenate(values), rcond=None
        )[0]
        return solution[0], solution[1:].T

    def _design(self, number: int, x: Float, y: Float) -> Float:
        (px, py), (cx, cy) = self.places[number], self.centre
        return np.stack([np.ones_like(x), x + px - cx, y + py - cy], axis=1)

    def non_linear(self, number: int, x: ArrayLike, y: ArrayLike) -> ChipField:
        """Residuals from the linear map on a grid of a chip.

        `x` (nx,) and `y` (ny,) are FITS 1-based pixels of the chip.
        """
        x, y = np.asarray(x, float), np.asarray(y, float)
        X, Y = mesh(x, y)
        constant, slope = self.linear
        residual = (
            self.chips[number].at(X, Y)
            - (self._design(number, X, Y) @ np.vstack([constant, slope.T])).T
        )
        shape = (y.size, x.size)
        du, dv = (d.reshape(shape) / self.scale for d in residual)
        on_x, on_y = (d.reshape(shape) for d in np.linalg.solve(slope, residual))
        px, py = self.places[number]
        return ChipField(number, x + px, y + py, du, dv, on_x, on_y)

    # -- areas --------------------------------------------------------------------------------

    @cached_property
    def central_slope(self) -> Float:
        """d(u, v) / d(x, y) at the centre, shape (2, 2): mean over the chips nearest to it."""
        near = {n: self._beyond(n) for n in self.chips}
        nearest = min(near.values())
        return np.mean(
            [
                self.chips[n].slope(*self._centre_on(n))[0]
                for n, far in near.items()
                if far < nearest + 1.0
            ],
            axis=0,
        )

    def _centre_on(self, number: int) -> tuple[Float, Float]:
        (cx, cy), (px, py) = self.centre, self.places[number]
        return np.array([cx - px]), np.array([cy - py])

    def _beyond(self, number: int) -> float:
        """Distance of the centre of the array from a chip, in pixels; 0 if it is on the chip."""
        size = self.chips[number].basis.size
        return max(
            max(0.5 - float(v[0]), float(v[0]) - n - 0.5, 0.0)
            for v, n in zip(self._centre_on(number), size, strict=True)
        )

    def relative_area(self, number: int, x: ArrayLike, y: ArrayLike) -> Float:
        """Pixel area (ny, nx) on a grid of a chip, relative to that at the centre."""
        area, _ = pixel_areas(self.chips[number], x, y)
        return area / abs(float(np.linalg.det(self.central_slope)))


def _middle(c: ChipMap) -> tuple[Float, Float]:
    nx, ny = c.basis.size
    return np.array([(nx + 1) / 2]), np.array([(ny + 1) / 2])


def _edge_points(c: ChipMap) -> tuple[Float, Float]:
    """Midpoints of the four edges of a chip."""
    (nx, ny), (mx, my) = c.basis.size, (v[0] for v in _middle(c))
    return np.array([mx, mx, 0.5, nx + 0.5]), np.array([0.5, ny + 0.5, my, my])
