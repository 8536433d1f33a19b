"""Positions at which errors are evaluated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.assess.regions import WHOLE, Region, in_region
from bayesdist.assess.solution import place_of
from bayesdist.errors import InputError
from bayesdist.model import DistortionModel
from bayesdist.model.grid import grid_pixels, mesh

__all__ = ["EvaluationDomain", "WorstPosition"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

MIN_POSITIONS = 4  # of a region


@dataclass(frozen=True)
class WorstPosition:
    """Position at which an error is largest."""

    chip: int  # number
    x: float  # FITS 1-based pixels
    y: float
    rms: float  # root mean square of the error there over the draws


@dataclass(frozen=True, eq=False)
class EvaluationDomain:
    """Positions on one chip or more, at one epoch, of one kind of star.

    Two domains of the same positions, epoch and star are equal.

    Parameters
    ----------
    model : DistortionModel
    chip : ndarray of int, shape (N,)
        Numbers of the chips; positions of one chip stand together.
    x, y : ndarray, shape (N,)
        FITS 1-based pixels.
    epoch : float or None
        Decimal years.
    magnitude : float or None
        Of the star: its centroid's error counts in.
    relative : str
        'pairs' where errors are those of differences of any two positions, 'first' where they are
        those of the differences to the first one; empty for errors of positions.
    separation : float or None
        Pixels that the two of a pair are apart at most, on one chip.
    grid : tuple of int or None
        Points on x and y of each chip where the positions are those of a grid, or of a part of it.
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
        """Points of the same grid on some chips, or on a region of each.

        Parameters
        ----------
        model : DistortionModel
        grid : tuple of int
            Points on x and y of a chip.
        chips : sequence of int, optional
            Numbers; all by default.
        region : str or tuple of (x, y), optional
            As `check_region` gives it.
        epoch, magnitude, separation
            As of the class.
        relative : bool
            Whether errors are those of differences.

        Raises
        ------
        InputError
            For an unknown chip, a missing epoch, a bad grid, and a region that holds fewer than
            four points of the grid.
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
        """Some pixels of one chip.

        Parameters
        ----------
        model : DistortionModel
        chip : int
        x, y : array_like, shape (N,)
            FITS 1-based pixels; two or more for relative errors.
        epoch, magnitude
            As of the class.
        relative : bool
            Whether errors are those of the differences to the first pixel.

        Raises
        ------
        InputError
            For an unknown chip, a missing epoch, a position off the chip, and relative errors of
            one position.
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
            raise InputError("a relative error is of two positions", do="give a second one")
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
        """Domain of these positions at another epoch."""
        return replace(self, epoch=None if epoch is None else float(epoch))

    def on(self, chip: int) -> EvaluationDomain:
        """Domain of the positions that are on one chip."""
        rows = self.chip == chip
        return replace(self, chip=self.chip[rows], x=self.x[rows], y=self.y[rows])

    @property
    def positions(self) -> EvaluationDomain:
        """The positions by themselves, not relative to each other."""
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
        """Number and rows of each chip."""
        start = 0
        for number in self.chips:
            stop = start + int((self.chip == number).sum())
            yield number, slice(start, stop)
            start = stop

    @cached_property
    def basis(self) -> dict[int, Float]:
        """Basis functions (N, K) of the model at the positions on each chip, by its number."""
        return {
            chip: self.model.basis(chip).evaluate(self.x[rows], self.y[rows])
            for chip, rows in self.by_chip()
        }

    def pairs(self) -> Int | None:
        """Pairs of positions, shape (2, P), whose differences count; None where none do.

        Raises
        ------
        InputError
            Where no two positions are that near.
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
