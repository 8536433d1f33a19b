"""Of which places an error is judged, and the error fields drawn there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.requirements.regions import Region, in_region
from bayesdist.assess.terms.fields import MODEL, ErrorDraws, ErrorFields
from bayesdist.errors import InputError
from bayesdist.model import Chip
from bayesdist.model.grid import grid_pixels, mesh

__all__ = ["Judged", "JudgedFields", "Place", "judged_fields"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

MOST_PAIRS = 5000  # pairs of places that stand for all: percentiles over them to about 1 %
FEWEST_PLACES = 4


@dataclass(frozen=True)
class Judged:
    """Of which places an error is judged, and of which star.

    Parameters
    ----------
    chips : tuple of Chip
    epoch : float or None
        Decimal years.
    region : str or tuple of (x, y)
    relative : bool
        Whether the error is that of the difference of two positions.
    separation : float or None
        Pixels that the two are apart at most.
    magnitude : float or None
    """

    chips: tuple[Chip, ...]
    epoch: float | None
    region: Region
    relative: bool = False
    separation: float | None = None
    magnitude: float | None = None


@dataclass(frozen=True)
class Place:
    """Where an error is largest.

    Parameters
    ----------
    chip : int
        Number.
    x, y : float
        FITS 1-based pixels.
    rms : float
        Root mean square of the error there over the draws.
    """

    chip: int
    x: float
    y: float
    rms: float


@dataclass(frozen=True, eq=False)
class JudgedFields:
    """Error fields of some chips, and which points of each grid they are known at.

    Parameters
    ----------
    fields : tuple of ErrorFields
        At the points that are judged, one for each chip.
    inside : tuple of ndarray of bool, shape (nx ny,)
        Which points of the grid these are.
    grid : tuple of int
        Points on x and y of a chip.
    """

    fields: tuple[ErrorFields, ...]
    inside: tuple[NDArray[np.bool_], ...]
    grid: tuple[int, int]

    @property
    def size(self) -> int:
        """Number of places, N."""
        return sum(f.x.size for f in self.fields)

    @property
    def places(self) -> tuple[Int, Float, Float]:
        """Chip number, x and y of each place, (N,)."""
        chip = np.repeat([f.chip for f in self.fields], [f.x.size for f in self.fields])
        x, y = (np.concatenate([getattr(f, a) for f in self.fields]) for a in "xy")
        return chip, x, y

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts that are fields, without the joint error."""
        return tuple(name for name in self.fields[0].parts if name != MODEL)

    def at(self, k: int) -> tuple[int, float, float]:
        """Chip number and pixel of one place."""
        chip, x, y = self.places
        return int(chip[k]), float(x[k]), float(y[k])

    def variance(self, part: str) -> Float:
        """Mean square of a part at each place, (N, 2)."""
        return np.concatenate([np.stack(f.sigma(part), axis=1) ** 2 for f in self.fields])

    def joint(self, rows: slice, shrink: Mapping[str, float]) -> Float:
        """The joint error (rows, N, 2) of some draws, parts of it taken off to a factor."""
        return np.concatenate([_shrunk(f, rows, shrink) for f in self.fields], axis=1)

    def factor(self, shrink: Mapping[str, float]) -> Float | float:
        """What multiplies the joint error (N, 2) where parts shrink that cannot be taken off.

        The spread of the solution shrinks at each place as the part's share in its variance says.
        """
        held = shrink.keys() & set(self.parts)
        if not held:
            return 1.0
        whole = self.variance(MODEL)
        left = whole - sum(
            (1.0 - shrink[name] ** 2) * np.minimum(self.variance(name), whole) for name in held
        )
        return np.sqrt(np.maximum(left, 0.0) / np.where(whole > 0, whole, 1.0))

    def pairs(self, separation: float | None, rng: np.random.Generator) -> Int:
        """Pairs of places, shape (2, P): all, or so many that they stand for all.

        Parameters
        ----------
        separation : float or None
            Pixels that the two are apart at most, on one chip.
        rng : numpy.random.Generator
            Chooses among too many.

        Raises
        ------
        InputError
            Where no two places are that near.
        """
        first, second = np.triu_indices(self.size, 1)
        if separation is not None:
            chip, x, y = self.places
            near = (chip[first] == chip[second]) & (
                np.hypot(x[first] - x[second], y[first] - y[second]) <= separation
            )
            first, second = first[near], second[near]
            if not first.size:
                raise InputError(
                    f"no two points of the grid of {self.grid[0]} x {self.grid[1]} are within "
                    f"{separation:g} px of each other",
                    where="separation",
                    do="refine assess.grid, or enlarge the separation",
                )
        if first.size > MOST_PAIRS:
            chosen = rng.choice(first.size, MOST_PAIRS, replace=False)
            first, second = first[chosen], second[chosen]
        return np.stack([first, second])


def judged_fields(errors: ErrorDraws, judged: Judged, grid: tuple[int, int]) -> JudgedFields:
    """Error fields at the points of a region.

    Parameters
    ----------
    errors : ErrorDraws
    judged : Judged
    grid : tuple of int
        Points on x and y of a chip.

    Returns
    -------
    JudgedFields

    Raises
    ------
    InputError
        For a region that holds fewer than four points of the grid, and a missing epoch.
    """
    points, inside = {}, []
    for chip in judged.chips:
        x, y = mesh(*grid_pixels(chip.size, grid))
        inside.append(in_region(judged.region, chip.size, x, y))
        points[chip.number] = x[inside[-1]], y[inside[-1]]
    found = sum(int(k.sum()) for k in inside)
    if found < FEWEST_PLACES or not all(k.any() for k in inside):
        raise InputError(
            f"the region holds {found} points of the grid of {grid[0]} x {grid[1]}",
            where="region",
            do="enlarge the region, refine assess.grid, or name the chip that it lies on",
        )
    return JudgedFields(errors.at(points, epoch=judged.epoch), tuple(inside), grid)


def _shrunk(fields: ErrorFields, rows: slice, shrink: Mapping[str, float]) -> Float:
    """The joint error of some draws with some of its parts shrunk."""
    parts = fields.polynomials
    joint = parts[MODEL][rows]
    for name in shrink.keys() & parts.keys():
        joint = joint - (1.0 - shrink[name]) * parts[name][rows]
    return replace(fields, polynomials={MODEL: joint}).field(MODEL)
