"""A detector of one or several chips as one field: what of its distortion is not linear.

Section 4.1 of the ACS handbook tells scales, angles and areas of whole detectors, and draws the
chips of the WFC as one array.  Its non-linear part is what the best linear map of the whole field
leaves: so defined, the delivered table of the WFC gives the printed maximum.
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
    """The non-linear part of the distortion on a grid of one chip."""

    chip: int
    x: Float  # (nx,)
    y: Float  # (ny,), pixels of the detector as one array
    du: Float  # (ny, nx), along the axes of the undistorted frame, output pixels
    dv: Float  # (ny, nx)
    along_x: Float  # (ny, nx), the same vectors along the detector's axes, in its pixels
    along_y: Float  # (ny, nx)

    @property
    def length(self) -> Float:
        """Length of the vectors, (ny, nx), output pixels."""
        return np.hypot(self.du, self.dv)


@dataclass(frozen=True, eq=False)
class WholeDetector:
    """Chips that share one undistorted plane.

    InputError without chips, for a scale that is not positive, or a chip without area.
    """

    # by chip number; the first one's pixels are those of the whole array
    chips: Mapping[int, ChipMap]
    scale: float  # size of an output pixel, in the unit of the calibrations

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
                    "maps its middle to a line", where=f"{c.name}, chip {c.chip}", do="check it"
                )

    # -- the chips as one array -------------------------------------------------------------------

    @cached_property
    def places(self) -> dict[int, tuple[float, float]]:
        """Offset of a chip's pixels from pixels of the whole array.

        The gap between two chips is the way between their nearest edges in the undistorted plane,
        in pixels of the mean of both.
        """
        first, *others = self.chips
        out = {first: (0.0, 0.0)}
        a = self.chips[first]
        ax, ay = _edge_points(a)
        on_a = a.at(ax, ay)
        for number in others:
            b = self.chips[number]
            bx, by = _edge_points(b)
            on_b = b.at(bx, by)
            far = np.hypot(*(on_a[:, :, None] - on_b[:, None, :]))
            i, j = np.unravel_index(int(far.argmin()), far.shape)
            mean = (a.slope(ax[[i]], ay[[i]]) + b.slope(bx[[j]], by[[j]]))[0] / 2
            way = np.linalg.solve(mean, on_b[:, j] - on_a[:, i])
            out[number] = float(ax[i] + way[0] - bx[j]), float(ay[i] + way[1] - by[j])
        return out

    @cached_property
    def bounds(self) -> tuple[Float, Float]:
        """Lower left and upper right edge of the whole array, (2,) each."""
        low = np.min([np.array(p) + 0.5 for p in self.places.values()], axis=0)
        high = np.max(
            [np.array(p) + 0.5 + self.chips[n].basis.size for n, p in self.places.items()], axis=0
        )
        return low, high

    @property
    def centre(self) -> tuple[float, float]:
        """The middle of the whole array."""
        (low_x, low_y), (high_x, high_y) = self.bounds
        return float(low_x + high_x) / 2, float(low_y + high_y) / 2

    # -- the linear map ---------------------------------------------------------------------------

    @cached_property
    def linear(self) -> tuple[Float, Float]:
        """Best linear map from pixels of the whole array: values at its centre (2,), slope (2, 2).

        Least squares over the area of all chips; Gauss-Legendre nodes make the integrals exact.
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
        found = np.linalg.lstsq(w * np.concatenate(design), w * np.concatenate(values), rcond=None)[
            0
        ]
        return found[0], found[1:].T

    def _design(self, number: int, x: Float, y: Float) -> Float:
        (px, py), (cx, cy) = self.places[number], self.centre
        return np.stack([np.ones_like(x), x + px - cx, y + py - cy], axis=1)

    def non_linear(self, number: int, x: ArrayLike, y: ArrayLike) -> ChipField:
        """Displacements that the linear map leaves on a grid of a chip.

        `x`: (nx,). `y`: (ny,), FITS 1-based pixels of the chip.
        """
        x, y = np.asarray(x, float), np.asarray(y, float)
        X, Y = mesh(x, y)
        constant, slope = self.linear
        left = (
            self.chips[number].at(X, Y)
            - (self._design(number, X, Y) @ np.vstack([constant, slope.T])).T
        )
        shape = (y.size, x.size)
        du, dv = (d.reshape(shape) / self.scale for d in left)
        on_x, on_y = (d.reshape(shape) for d in np.linalg.solve(slope, left))
        px, py = self.places[number]
        return ChipField(number, x + px, y + py, du, dv, on_x, on_y)

    # -- areas --------------------------------------------------------------------------------

    @cached_property
    def central_slope(self) -> Float:
        """d(u, v) / d(x, y) at the centre, (2, 2): the mean of the chips that are nearest to it."""
        near = {n: self._beyond(n) for n in self.chips}
        least = min(near.values())
        return np.mean(
            [
                self.chips[n].slope(*self._centre_on(n))[0]
                for n, far in near.items()
                if far < least + 1.0
            ],
            axis=0,
        )

    def _centre_on(self, number: int) -> tuple[Float, Float]:
        (cx, cy), (px, py) = self.centre, self.places[number]
        return np.array([cx - px]), np.array([cy - py])

    def _beyond(self, number: int) -> float:
        """Distance of the centre of the array beyond a chip's edge, pixels."""
        size = self.chips[number].basis.size
        return max(
            max(0.5 - float(v[0]), float(v[0]) - n - 0.5, 0.0)
            for v, n in zip(self._centre_on(number), size, strict=True)
        )

    def relative_area(self, number: int, x: ArrayLike, y: ArrayLike) -> Float:
        """Pixel area over that at the centre, (ny, nx), on a grid of a chip."""
        area, _ = pixel_areas(self.chips[number], x, y)
        return area / abs(float(np.linalg.det(self.central_slope)))


def _middle(c: ChipMap) -> tuple[Float, Float]:
    nx, ny = c.basis.size
    return np.array([(nx + 1) / 2]), np.array([(ny + 1) / 2])


def _edge_points(c: ChipMap) -> tuple[Float, Float]:
    """The middles of a chip's edges."""
    (nx, ny), (mx, my) = c.basis.size, (v[0] for v in _middle(c))
    return np.array([mx, mx, 0.5, nx + 0.5]), np.array([0.5, ny + 0.5, my, my])
