"""All errors of a position, drawn once, and statistics of them over parts of the detector.

What is drawn serves every requirement, epoch and part of the detector, and every question of the
kind "what if this term were half as large": so differences between answers are not differences of
draws.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.field_terms import FieldTerm
from bayesdist.assess.fields import MODEL, ErrorDraws, ErrorFields, draw_errors
from bayesdist.assess.grid import grid_pixels, mesh
from bayesdist.assess.regions import Region, in_region
from bayesdist.assess.solution import Solution
from bayesdist.assess.statistics import extent, field_statistic
from bayesdist.assess.terms import LocalTerm, UserTerm
from bayesdist.data.magnitude_errors import MagnitudeErrors
from bayesdist.errors import InputError
from bayesdist.model import Chip

__all__ = ["CENTROID", "Judged", "Place", "PositionErrors", "position_errors"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

CENTROID = "centroid"

# Places times draws whose errors are held at once: two axes of them are 8 MB.
BLOCK = 500_000
MOST_PAIRS = 5000  # pairs of places that stand for all: percentiles over them to about 1 %
FEWEST_PLACES = 4
BEYOND = 0.5  # magnitudes by which the outermost bins may be left


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
class PositionErrors:
    """Draws of everything that moves a position.

    Parameters
    ----------
    fields : ErrorDraws
        Of the errors that are fields over the detector.
    terms : tuple of UserTerm
    sigmas : tuple of (float, float)
        Of these terms, in the unit of the solution.
    local : tuple of LocalTerm
    centroid : MagnitudeErrors or None
        Errors of a star's centroid, in the unit of the solution.
    grid : tuple of int
        Points on x and y of a chip.
    n_draws : int
    unit : str
    offsets : ndarray, shape (n_draws, 2)
        Standard normal: of the systematic terms, one for the whole field.
    seed : int
        Of the errors that are independent from place to place.
    """

    fields: ErrorDraws
    terms: tuple[UserTerm, ...]
    sigmas: tuple[tuple[float, float], ...]
    local: tuple[LocalTerm, ...]
    centroid: MagnitudeErrors | None
    grid: tuple[int, int]
    n_draws: int
    unit: str
    offsets: Float
    seed: int
    _kept: dict[Judged, _Drawn] = field(default_factory=dict, repr=False)

    def names(self, judged: Judged) -> tuple[str, ...]:
        """All terms that an error is made of there."""
        parts = [name for name in self._drawn(judged).fields[0].parts if name != MODEL]
        own = [CENTROID] if judged.magnitude is not None else []
        return (*parts, *(t.name for t in self.local), *(t.name for t in self.terms), *own)

    def statistics(
        self,
        judged: Judged,
        names: Sequence[str],
        *,
        shrink: Mapping[str, float] | None = None,
        n_draws: int | None = None,
    ) -> dict[str, Float]:
        """Statistics of each draw's error over the places.

        Parameters
        ----------
        judged : Judged
        names : sequence of str
            Of `STATISTICS`.
        shrink : mapping of str to float, optional
            Factors by which terms are multiplied.
        n_draws : int, optional
            The first so many of the draws; all by default.

        Returns
        -------
        dict of str to ndarray, shape (n_draws,)

        Raises
        ------
        InputError
            For a region that holds fewer than four points of the grid, no pair of places that near,
            a magnitude where no errors by magnitude are known, and a missing epoch.
        """
        n = n_draws or self.n_draws
        out = {name: np.empty(n) for name in names}
        pairs = self._pairs(judged) if judged.relative else None
        for rows, error in self._errors(judged, shrink or {}, n, pairs):
            seen = error if pairs is None else error[:, pairs[0]] - error[:, pairs[1]]
            for name in names:
                if pairs is not None and judged.separation is None and name.endswith("max"):
                    out[name][rows] = extent(name, error)  # over all pairs, not some of them
                else:
                    out[name][rows] = field_statistic(name, seen)
        return out

    def worst(self, judged: Judged, axis: str = "") -> Place:
        """The place at which the error is largest; of two positions, the one farther off.

        Parameters
        ----------
        judged : Judged
        axis : {'', 'u', 'v'}
            Of which axis; of both by default.
        """
        drawn = self._drawn(judged)
        variance = drawn.variance(MODEL)
        for shared, sigma in self._added(judged, {}):
            if not (shared and judged.relative):
                variance = variance + sigma**2
        total = variance.sum(axis=1) if not axis else variance[:, "uv".index(axis)]
        k = int(np.argmax(total))
        return Place(*drawn.at(k), float(np.sqrt(total[k])))

    def size(self, judged: Judged, name: str) -> float:
        """Radial root mean square of one term over the places."""
        drawn = self._drawn(judged)
        if name in drawn.fields[0].polynomials:
            variance = drawn.variance(name)
        else:
            others = {other: 0.0 for other in self.names(judged) if other != name}
            variance = sum(s**2 for _, s in self._added(judged, others))
        return float(np.sqrt(np.mean(variance.sum(axis=1))))

    def centroid_at(self, magnitude: float) -> Float:
        """Errors (2,) of the centroid of a star.

        Raises
        ------
        InputError
            Where no errors by magnitude are known, or none near this one.
        """
        if self.centroid is None:
            raise InputError(
                f"the error of a star of magnitude {magnitude:g} is not known",
                where="magnitude",
                do="give the matches magnitudes, or leave it out",
            )
        low, high = self.centroid.mag[0] - BEYOND, self.centroid.mag[-1] + BEYOND
        if not low <= magnitude <= high:
            raise InputError(
                f"centroids of magnitude {magnitude:g} were not measured, but those of "
                f"{low:.1f} to {high:.1f}",
                where="magnitude",
                do="name one of these",
            )
        return np.ravel(self.centroid.at([magnitude]))

    # -- the draws --------------------------------------------------------------------------------

    def _errors(
        self, judged: Judged, shrink: Mapping[str, float], n: int, pairs: Int | None
    ) -> Iterator[tuple[slice, Float]]:
        """Errors (rows, N, 2) of blocks of draws, all terms together."""
        drawn = self._drawn(judged)
        added = self._added(judged, shrink)
        shared, single = (
            np.sqrt(sum(s**2 for is_shared, s in added if is_shared == which))
            for which in (True, False)
        )
        exact = {name: s for name, s in shrink.items() if self._beside(name)}
        factor = self._factor(drawn, {k: s for k, s in shrink.items() if k not in exact})
        rng = np.random.default_rng(self.seed)  # the same at every epoch and for every what-if
        step = max(1, BLOCK // max(drawn.size, 0 if pairs is None else pairs.shape[1]))
        for start in range(0, n, step):
            rows = slice(start, min(start + step, n))
            error = np.concatenate([_shrunk(f, rows, exact) for f in drawn.fields], axis=1)
            error *= factor
            error += self.offsets[rows, None, :] * shared
            if np.any(single):
                error += rng.standard_normal(error.shape) * single
            yield rows, error

    def _drawn(self, judged: Judged) -> _Drawn:
        """Fields at the points of the region."""
        key = replace(judged, relative=False, separation=None, magnitude=None)
        if key not in self._kept:
            points, inside = {}, []
            for chip in judged.chips:
                x, y = mesh(*grid_pixels(chip.size, self.grid))
                inside.append(in_region(judged.region, chip.size, x, y))
                points[chip.number] = x[inside[-1]], y[inside[-1]]
            found = sum(int(k.sum()) for k in inside)
            if found < FEWEST_PLACES or not all(k.any() for k in inside):
                raise InputError(
                    f"the region holds {found} points of the grid of "
                    f"{self.grid[0]} x {self.grid[1]}",
                    where="region",
                    do="enlarge the region, refine assess.grid, or name the chip that it lies on",
                )
            fields = self.fields.at(points, epoch=judged.epoch)
            self._kept[key] = _Drawn(fields, tuple(inside))
        return self._kept[key]

    def _beside(self, name: str) -> bool:
        """Whether a part is drawn together with the joint error, so that it can be taken off it."""
        if name in self.fields.terms:
            return name in self.fields.added
        return self.fields.whole is self.fields.shown

    def _added(self, judged: Judged, shrink: Mapping[str, float]) -> list[tuple[bool, Float]]:
        """Whether all places share an error, and its sigmas (N, 2), of terms that are no fields."""
        drawn = self._drawn(judged)
        N = drawn.size
        out = [(True, np.zeros((N, 2))), (False, np.zeros((N, 2)))]
        for term, sigma in zip(self.terms, self.sigmas, strict=True):
            value = np.tile(sigma, (N, 1)) * shrink.get(term.name, 1.0)
            out.append((term.kind == "systematic", value))
        for one in self.local:
            on_chips = [
                np.column_stack([s.ravel() for s in one.on(f.chip, self.grid[::-1])])[inside]
                for f, inside in zip(drawn.fields, drawn.inside, strict=True)
            ]
            out.append((False, np.concatenate(on_chips) * shrink.get(one.name, 1.0)))
        if judged.magnitude is not None:
            at = self.centroid_at(judged.magnitude)
            out.append((False, np.tile(at, (N, 1)) * shrink.get(CENTROID, 1.0)))
        return out

    def _factor(self, drawn: _Drawn, shrink: Mapping[str, float]) -> Float | float:
        """What multiplies the joint error (N, 2) where parts of it shrink that cannot be taken off.

        The spread of the solution shrinks at each place as the part's share in its variance says.
        """
        held = shrink.keys() & drawn.fields[0].polynomials.keys()
        if not held:
            return 1.0
        whole = drawn.variance(MODEL)
        left = whole - sum(
            (1.0 - shrink[name] ** 2) * np.minimum(drawn.variance(name), whole) for name in held
        )
        return np.sqrt(np.maximum(left, 0.0) / np.where(whole > 0, whole, 1.0))

    def _pairs(self, judged: Judged) -> Int:
        """Pairs of places, shape (2, P): all, or so many that they stand for all."""
        drawn = self._drawn(judged)
        first, second = np.triu_indices(drawn.size, 1)
        if judged.separation is not None:
            chip, x, y = drawn.places
            near = (chip[first] == chip[second]) & (
                np.hypot(x[first] - x[second], y[first] - y[second]) <= judged.separation
            )
            first, second = first[near], second[near]
            if not first.size:
                raise InputError(
                    f"no two points of the grid of {self.grid[0]} x {self.grid[1]} are within "
                    f"{judged.separation:g} px of each other",
                    where="separation",
                    do="refine assess.grid, or enlarge the separation",
                )
        if first.size > MOST_PAIRS:
            chosen = np.random.default_rng(self.seed).choice(first.size, MOST_PAIRS, replace=False)
            first, second = first[chosen], second[chosen]
        return np.stack([first, second])


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Error fields of some chips, and which points of each grid they are known at."""

    fields: tuple[ErrorFields, ...]
    inside: tuple[NDArray[np.bool_], ...]

    @property
    def size(self) -> int:
        """Number of places."""
        return sum(f.x.size for f in self.fields)

    @property
    def places(self) -> tuple[Int, Float, Float]:
        """Chip number, x and y of each place, (N,)."""
        chip = np.repeat([f.chip for f in self.fields], [f.x.size for f in self.fields])
        x, y = (np.concatenate([getattr(f, a) for f in self.fields]) for a in "xy")
        return chip, x, y

    def at(self, k: int) -> tuple[int, float, float]:
        """Chip number and pixel of one place."""
        chip, x, y = self.places
        return int(chip[k]), float(x[k]), float(y[k])

    def variance(self, part: str) -> Float:
        """Mean square of a part at each place, (N, 2)."""
        return np.concatenate([np.stack(f.sigma(part), axis=1) ** 2 for f in self.fields])


def _shrunk(fields: ErrorFields, rows: slice, shrink: Mapping[str, float]) -> Float:
    """The joint error of some draws with some of its parts shrunk."""
    parts = fields.polynomials
    joint = parts[MODEL][rows]
    for name in shrink.keys() & parts.keys():
        joint = joint - (1.0 - shrink[name]) * parts[name][rows]
    return replace(fields, polynomials={MODEL: joint}).field(MODEL)


def position_errors(
    solution: Solution,
    *,
    terms: Sequence[UserTerm] = (),
    fields: Sequence[FieldTerm] = (),
    aligned: bool = False,
    local: Sequence[LocalTerm] = (),
    centroid: MagnitudeErrors | None = None,
    grid: tuple[int, int],
    n_draws: int,
    rng: np.random.Generator,
    pixel_scale: float | None = None,
) -> PositionErrors:
    """Draw all errors of a position.

    Parameters
    ----------
    solution, terms, fields, aligned, local, grid, n_draws, rng, pixel_scale
        As `check_requirements`.
    centroid : MagnitudeErrors, optional
        Errors of centroids by magnitude, in the unit of the solution.

    Returns
    -------
    PositionErrors

    Raises
    ------
    InputError
        For fewer than two draws, and units that need a pixel scale that is not known.
    """
    unit = solution.model.unit
    sigmas = tuple(t.sigma(unit, pixel_scale) for t in terms)
    return PositionErrors(
        fields=draw_errors(solution, n_draws, rng, fields=fields, aligned=aligned),
        terms=tuple(terms),
        sigmas=sigmas,
        local=tuple(local),
        centroid=centroid,
        grid=grid,
        n_draws=n_draws,
        unit=unit,
        offsets=rng.standard_normal((n_draws, 2)),
        seed=int(rng.integers(2**63)),
    )
