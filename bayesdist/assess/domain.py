"""Positions at which errors are evaluated, and statistics that reduce an error field to one number.

Positions are on whole chips or in regions of them, at an epoch and optionally for the magnitude of
a star.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.assess.solution import place_of
from bayesdist.errors import InputError, require_known
from bayesdist.model import DistortionModel
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.utils.arrays import Bool, Float, Int

MIN_POSITIONS = 4  # least number of grid points in a region
Region: TypeAlias = "str | tuple[tuple[float, float], ...]"
WHOLE = "whole"
QUADRANTS = ("lower left", "lower right", "upper left", "upper right")
_INNER = re.compile(r"inner\s+(\d+(?:\.\d*)?)\s*%")
_NUMBER = r"(-?\d+(?:\.\d*)?(?:e[+-]?\d+)?)"
_CIRCLE = re.compile(rf"circle of radius {_NUMBER} about \({_NUMBER}, {_NUMBER}\)")
_PERCENTILES = {"p50": 50.0, "p68": 68.0, "p90": 90.0, "p95": 95.0, "p99": 99.0}
_DIRECTIONS = 64  # number of directions over 180 degrees
_BASE = ("max", "rms", "mean", *_PERCENTILES)
STATISTICS = (*_BASE, *(f"u_{s}" for s in _BASE), *(f"v_{s}" for s in _BASE))


@dataclass(frozen=True)
class WorstPosition:
    """Position at which an error is largest."""

    chip: int  # number
    x: float  # FITS 1-based pixels
    y: float
    rms: float  # rms of the error at this position over the draws


@dataclass(frozen=True, eq=False)
class EvaluationDomain:
    """Positions on one or several chips, with an epoch and optionally the magnitude of a star.

    Domains with the same positions, epoch and magnitude compare equal.

    Parameters
    ----------
    model : DistortionModel
    chip : ndarray of int, shape (N,)
        Chip number of each position; positions on the same chip must be contiguous.
    x, y : ndarray, shape (N,)
        FITS 1-based pixels.
    epoch : float or None
        Decimal years.
    magnitude : float or None
        Magnitude of the star, for which the error of its centroid is included; None for no centroid
        error.
    relative : str
        'pairs' for errors of the differences between any two positions, 'first' for differences
        from the first position, or empty for errors of positions.
    separation : float or None
        Maximum separation of the two positions of a pair, in pixels on the same chip.
    grid : tuple of int or None
        Number of points along x and y of each chip, if the positions are those of a grid or of a
        part of it.
    """

    model: DistortionModel
    chip: Int
    x: Float
    y: Float
    epoch: float | None = None
    magnitude: float | None = None
    relative: str = ""
    separation: float | None = None
    grid: tuple[int, int] | None = None

    @classmethod
    def of_chips(
        cls,
        model: DistortionModel,
        grid: tuple[int, int],
        *,
        chips: Sequence[int] | None = None,
        region: Region = WHOLE,
        epoch: float | None = None,
        magnitude: float | None = None,
        relative: bool = False,
        separation: float | None = None,
    ) -> EvaluationDomain:
        """Grid points on some chips, or on a region of each chip.

        Parameters
        ----------
        model : DistortionModel
        grid : tuple of int
            Number of points along x and y of a chip.
        chips : sequence of int, optional
            Chip numbers; all chips by default.
        region : str or tuple of (x, y), optional
            Region of each chip, as returned by `check_region`.
        epoch, magnitude, separation
            See `EvaluationDomain`.
        relative : bool
            True for errors of differences between positions.

        Returns
        -------
        EvaluationDomain

        Raises
        ------
        InputError
            If a chip is unknown, the epoch is missing, the grid is invalid, or the region contains
            fewer than four grid points.
        """
        numbers = [c.number for c in model.chips] if chips is None else list(chips)
        points: list[tuple[Float, Float]] = []
        for number in numbers:
            size = place_of(model, epoch=epoch, chip=number).chip.size
            x, y = mesh(*grid_pixels(size, grid))
            inside = in_region(region, size, x, y)
            points.append((x[inside], y[inside]))
        counts = [len(x) for x, _ in points]
        if region != WHOLE and (sum(counts) < MIN_POSITIONS or 0 in counts):
            raise InputError(
                f"the region holds {sum(counts)} points of the grid of {grid[0]} x {grid[1]}",
                where="region",
                do="enlarge the region, refine assess.grid, or name the chip that it lies on",
            )
        return cls(
            model,
            np.repeat(np.array(numbers, np.int64), counts),
            np.concatenate([x for x, _ in points]),
            np.concatenate([y for _, y in points]),
            epoch=None if epoch is None else float(epoch),
            magnitude=magnitude,
            relative="pairs" if relative else "",
            separation=separation,
            grid=(int(grid[0]), int(grid[1])),
        )

    @classmethod
    def at_pixels(
        cls,
        model: DistortionModel,
        chip: int,
        x: ArrayLike,
        y: ArrayLike,
        *,
        epoch: float | None = None,
        magnitude: float | None = None,
        relative: bool = False,
    ) -> EvaluationDomain:
        """Given pixels of one chip.

        Parameters
        ----------
        model : DistortionModel
        chip : int
            Chip number.
        x, y : array_like, shape (N,)
            FITS 1-based pixels; at least two for relative errors.
        epoch, magnitude
            See `EvaluationDomain`.
        relative : bool
            True for errors of the differences from the first pixel.

        Returns
        -------
        EvaluationDomain

        Raises
        ------
        InputError
            If the chip is unknown, the epoch is missing, a position is off the chip, or a relative
            error of a single position is requested.
        """
        size = place_of(model, epoch=epoch, chip=chip).chip.size
        x, y = (np.atleast_1d(np.asarray(a, float)) for a in (x, y))
        for name, values, extent in zip("xy", (x, y), size, strict=True):
            outside = ~((values >= 0.5) & (values <= extent + 0.5))
            if outside.any():
                raise InputError(
                    f"{name} = {values[int(np.argmax(outside))]:g} is not on chip {chip} of "
                    f"{size[0]:g} x {size[1]:g} pixels",
                    do="give FITS 1-based pixels",
                )
        if relative and x.size < 2:
            raise InputError("a relative error needs two positions", do="give a second one")
        return cls(
            model,
            np.full(x.size, chip, np.int64),
            x,
            y,
            epoch=None if epoch is None else float(epoch),
            magnitude=magnitude,
            relative="first" if relative else "",
        )

    def at(self, epoch: float | None) -> EvaluationDomain:
        """Domain with the same positions at another epoch."""
        return replace(self, epoch=None if epoch is None else float(epoch))

    def on(self, chip: int) -> EvaluationDomain:
        """Domain with only the positions on one chip."""
        rows = self.chip == chip
        return replace(self, chip=self.chip[rows], x=self.x[rows], y=self.y[rows])

    @property
    def positions(self) -> EvaluationDomain:
        """Domain with the same positions for absolute instead of relative errors."""
        return replace(self, relative="", separation=None) if self.relative else self

    @property
    def size(self) -> int:
        """Number of positions, N."""
        return self.x.size

    @cached_property
    def chips(self) -> tuple[int, ...]:
        """Numbers of the chips, in the order of the positions."""
        return tuple(dict.fromkeys(self.chip.tolist()))

    def by_chip(self) -> Iterator[tuple[int, slice]]:
        """Yield each chip number with the slice of its positions."""
        start = 0
        for number in self.chips:
            stop = start + int((self.chip == number).sum())
            yield number, slice(start, stop)
            start = stop

    @cached_property
    def basis(self) -> dict[int, Float]:
        """Basis functions (n, K) of the model at the n positions on each chip, by chip number."""
        return {
            chip: self.model.basis(chip).evaluate(self.x[rows], self.y[rows])
            for chip, rows in self.by_chip()
        }

    def pairs(self) -> Int | None:
        """Indices of the pairs of positions, shape (2, P); None if the domain is not relative.

        Raises
        ------
        InputError
            If no two positions are within `separation`.
        """
        if not self.relative:
            return None
        if self.relative == "first":
            second = np.arange(1, self.size)
            return np.stack([np.zeros_like(second), second])
        first, second = np.triu_indices(self.size, 1)
        if self.separation is not None:
            near = (self.chip[first] == self.chip[second]) & (
                np.hypot(self.x[first] - self.x[second], self.y[first] - self.y[second])
                <= self.separation
            )
            first, second = first[near], second[near]
            if not first.size:
                of_grid = "" if self.grid is None else " of {} x {}".format(*self.grid)
                raise InputError(
                    f"no two points of the grid{of_grid} are within {self.separation:g} px of "
                    "each other",
                    where="separation",
                    do="refine assess.grid, or enlarge the separation",
                )
        return np.stack([first, second])

    @cached_property
    def _key(self) -> tuple[Any, ...]:
        arrays = tuple(a.tobytes() for a in (self.chip, self.x, self.y))
        return (*arrays, self.epoch, self.magnitude, self.relative, self.separation, self.grid)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, EvaluationDomain):
            return NotImplemented
        return self.model is other.model and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


def check_region(
    region: Region | Sequence[Sequence[float]] | Mapping[str, Any], where: str
) -> Region:
    """Normalise a region to a form that can be compared.

    `region`: 'whole'; 'inner 80 %', the central rectangle with this fraction of both sides of the
    chip; a quadrant: 'lower left', 'lower right', 'upper left', 'upper right'; the corners of a
    polygon in FITS 1-based pixels; or a mapping with the centre [x, y] and radius of a circle,
    which is returned as 'circle of radius 900 about (1024.5, 1024.5)'. `where`: location for the
    error message. Raises InputError for anything else.
    """
    if isinstance(region, Mapping):
        return _circle(region, where)
    if isinstance(region, str):
        text = " ".join(region.lower().split())
        if _CIRCLE.fullmatch(text):
            return text
        inner = _INNER.fullmatch(text)
        if text in (WHOLE, *QUADRANTS) or (inner and 0 < float(inner[1]) <= 100):
            return text
        raise InputError(
            f"there is no region {region!r}",
            where=where,
            do=f"name 'whole', 'inner 80 %', {', '.join(map(repr, QUADRANTS))}, or give the "
            "corners of a polygon, [[x, y], ...], or {centre = [x, y], radius = r}",
        )
    corners = tuple(tuple(float(value) for value in corner) for corner in region)
    if len(corners) < 3 or any(len(c) != 2 or not np.isfinite(c).all() for c in corners):
        raise InputError(
            f"a polygon of {len(corners)} corners is no region"
            if len(corners) < 3
            else "a corner of the polygon is not two numbers",
            where=where,
            do="give three or more corners, [[x, y], ...] in pixels",
        )
    return tuple((x, y) for x, y in corners)


def _circle(given: Mapping[str, Any], where: str) -> str:
    """Text that describes a circle and is parsed by `in_region`."""
    try:
        (x, y), radius = (float(v) for v in given["centre"]), float(given["radius"])
    except (KeyError, TypeError, ValueError):
        x = y = radius = np.nan
    if given.keys() != {"centre", "radius"} or not np.isfinite([x, y]).all() or not radius > 0:
        raise InputError(
            f"{dict(given)} is no circle",
            where=where,
            do="give {centre = [x, y], radius = r} in pixels",
        )
    return f"circle of radius {radius!r} about ({x!r}, {y!r})"


def in_region(region: Region, size: tuple[float, float], x: Float, y: Float) -> Bool:
    """Boolean mask of the pixels in a region; rectangles include their edges.

    `region`: as returned by `check_region`. `size`: numbers of columns and rows of the chip. `x`,
    `y`: FITS 1-based pixels, shape (N,). Returns an array of shape (N,).
    """
    if not isinstance(region, str):
        return _in_polygon(np.array(region), x, y)
    circle = _CIRCLE.fullmatch(region)
    if circle:
        radius, x0, y0 = map(float, circle.groups())
        return np.asarray(np.hypot(x - x0, y - y0) <= radius)
    # from -1 to 1 between the centres of the outermost pixels
    X, Y = (2.0 * (a - 1.0) / (n - 1.0) - 1.0 for a, n in zip((x, y), size, strict=True))
    if region in QUADRANTS:
        upper, right = region.startswith("upper"), region.endswith("right")
        return np.asarray(((Y >= 0) if upper else (Y <= 0)) & ((X >= 0) if right else (X <= 0)))
    inner = _INNER.fullmatch(region)
    half = float(inner[1]) / 100 if inner else 1.0
    return np.asarray(np.maximum(np.abs(X), np.abs(Y)) <= half + 1e-12)


def _in_polygon(corners: Float, x: Float, y: Float) -> Bool:
    """Boolean mask of pixels in a polygon: a ray to the right crosses an odd number of sides."""
    inside = np.zeros(np.shape(x), bool)
    for (x1, y1), (x2, y2) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y1 == y2:
            continue
        crossing = x1 + (y - y1) / (y2 - y1) * (x2 - x1)
        inside ^= ((y1 > y) != (y2 > y)) & (x < crossing)
    return inside


def region_words(region: Region) -> str:
    """Text such as ' over the inner 80 %'; empty for the whole chip."""
    if region == WHOLE:
        return ""
    if isinstance(region, str):
        circle = _CIRCLE.fullmatch(region)
        if circle:
            radius, x, y = map(float, circle.groups())
            return f" over the circle of radius {radius:g} about ({x:g}, {y:g})"
        return f" over the {region}" + (" quadrant" if region in QUADRANTS else "")
    return f" over a polygon of {len(region)} corners"


def field_statistic(name: str, error: Float) -> Float:
    """Statistic of error fields over their positions.

    Parameters
    ----------
    name : str
        One of `STATISTICS`. It applies to the radial error, or with the prefix ``u_`` or ``v_`` to
        the absolute error of one axis.
    error : ndarray, shape (..., N, 2)
        Errors of u and v at N positions.

    Returns
    -------
    ndarray, shape (...)

    Raises
    ------
    InputError
        If the statistic is unknown.
    """
    require_known(name, STATISTICS, "statistic")
    axis, _, base = name.rpartition("_")
    return of_sizes(base, sizes(axis, error))


def sizes(axis: str, error: Float) -> Float:
    """Absolute errors (..., N) of an axis, or radial errors if `axis` is empty.

    `axis` is 'u', 'v' or empty, and `error` has shape (..., N, 2).
    """
    if axis:
        return np.abs(error[..., "uv".index(axis)])
    return np.sqrt(error[..., 0] ** 2 + error[..., 1] ** 2)  # five times as fast as `hypot`


def of_sizes(base: str, size: Float) -> Float:
    """Statistic (...) of sizes (..., N) over the last axis.

    `base` is 'max', 'mean', 'rms' or the name of a percentile.
    """
    if base == "max":
        return size.max(axis=-1)
    if base == "mean":
        return size.mean(axis=-1)
    if base == "rms":
        return np.sqrt(np.mean(size**2, axis=-1))
    return np.percentile(size, _PERCENTILES[base], axis=-1)


def extent(name: str, error: Float) -> Float:
    """Largest difference between the errors at any two positions.

    `name`: 'max', 'u_max' or 'v_max'. `error`: shape (..., N, 2). Returns an array of shape (...).
    For 'max' it is the largest extent along any of 64 directions, which underestimates the largest
    distance by at most 0.03 %.
    """
    axis = name.removesuffix("max").rstrip("_")
    if axis:
        return np.ptp(error[..., "uv".index(axis)], axis=-1)
    angles = np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    along = (np.ptp(error @ [np.cos(a), np.sin(a)], axis=-1) for a in angles)
    return functools.reduce(np.maximum, along)
