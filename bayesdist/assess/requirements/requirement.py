"""A requirement on the position error: statistic, limit, region, epoch and probability."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

from bayesdist.assess.domain import (
    STATISTICS,
    WHOLE,
    Region,
    check_region,
    in_region,
    region_words,
)
from bayesdist.assess.units import stated_unit
from bayesdist.data.tables.column import UNITS
from bayesdist.diagnose.residuals.binned import Coverage
from bayesdist.errors import InputError, require_known
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.utils.checks import BEYOND_STARS
from bayesdist.utils.quantities import unit_name, value_in, year_of


@dataclass(frozen=True)
class Requirement:
    """A limit on a statistic of the position error over the detector, which includes all chips.

    Parameters
    ----------
    name : str
        Name of the requirement.
    statistic : str
        One of `STATISTICS`.
    limit : float or Quantity
        Positive; stored as a number in `unit`.
    unit : str, optional
        'pix', 'arcsec', 'mas' or 'deg'; ignored if the limit is a Quantity. It may be omitted
        (empty) for models with u and v in pixels; see `in_unit_of`.
    probability : float
        Probability with which the statistic must not exceed the limit, between 0 and 1.
    epoch : float, str, Time, date or Quantity, optional
        Stored in decimal years.
    chip : int, optional
        Number of the only chip that is judged; all chips together by default.
    region : str or sequence of (x, y)
        The part of each chip that is judged; see `check_region`.
    epochs : tuple of float, optional
        First and last epoch of a range, instead of `epoch`: the limit must be met throughout.
    relative : bool
        True for the error of the difference between two positions in one image, over all pairs of
        positions, instead of the error of a position.
    separation : float or Quantity, optional
        Largest separation of the pairs in pixels, on the same chip; only for relative errors.
    magnitude : float or Quantity, optional
        Magnitude of a star, for which the error of its centroid is included.

    Raises
    ------
    InputError
        If the statistic, unit or region is unknown, a number is out of range, or parameters
        contradict each other.

    Examples
    --------
    >>> need = bd.Requirement("field-wide", "p95", 0.03, "pix", probability=0.95)
    >>> need.unit
    'pix'
    """

    name: str
    statistic: str
    limit: float
    unit: str = ""
    probability: float = 0.95
    epoch: float | None = None
    chip: int | None = None
    region: Region = WHOLE
    epochs: tuple[float, float] | None = None
    relative: bool = False
    separation: float | None = None
    magnitude: float | None = None

    def __post_init__(self) -> None:
        require_known(self.statistic, STATISTICS, "statistic", where=self.where)
        if self.unit:
            require_known(self.unit, UNITS, "unit", where=self.where)
        unit = unit_name(self.limit, "limit", where=self.where) or self.unit or ""
        # the unit has no effect on a plain number
        limit = value_in(self.limit, unit or "pix", "limit", where=self.where)
        object.__setattr__(self, "limit", limit)
        object.__setattr__(self, "unit", unit)
        object.__setattr__(self, "region", check_region(self.region, self.where))
        if self.separation is not None:
            apart = value_in(self.separation, "pix", "separation", where=self.where)
            object.__setattr__(self, "separation", apart)
        if self.magnitude is not None:
            magnitude = value_in(self.magnitude, "mag", "magnitude", where=self.where)
            object.__setattr__(self, "magnitude", magnitude)
        if self.epoch is not None:
            object.__setattr__(self, "epoch", year_of(self.epoch, where=self.where))
        if self.epochs is not None:
            years = tuple(year_of(epoch, "epochs", where=self.where) for epoch in self.epochs)
            object.__setattr__(self, "epochs", years)
        for wrong, cause, do in (
            (
                not (math.isfinite(self.limit) and self.limit > 0),
                f"the limit is {self.limit}",
                "give a positive number",
            ),
            (
                not (isinstance(self.probability, Real) and 0 < self.probability < 1),
                f"the probability is {self.probability!r}",
                "give a number between 0 and 1, without the ends",
            ),
            (
                self.epochs is not None and self.epoch is not None,
                "it names an epoch and a range of epochs",
                "give one of the two",
            ),
            (
                self.epochs is not None
                and not (len(self.epochs) == 2 and self.epochs[0] < self.epochs[1]),
                f"the range of epochs is {self.epochs}",
                "give the first and the last, in decimal years",
            ),
            (
                self.separation is not None and not self.relative,
                "a separation needs two positions, but the error is that of one",
                "set relative = true, or leave separation out",
            ),
            (
                self.separation is not None and not self.separation > 0,
                f"the separation is {self.separation}",
                "give a positive number of pixels",
            ),
        ):
            if wrong:
                raise InputError(cause, where=self.where, do=do)

    def in_unit_of(self, unit: str) -> Requirement:
        """Requirement with a unit: its stated unit, or pixels if u and v are in pixels.

        Parameters
        ----------
        unit : str
            Unit of u and v.

        Returns
        -------
        Requirement

        Raises
        ------
        InputError
            If it has no unit, and u and v are angles.
        """
        return self if self.unit else replace(self, unit=stated_unit(self.unit, unit, self.where))

    @property
    def where(self) -> str:
        """Name of the requirement in error messages."""
        return f"requirement {self.name!r}"

    @property
    def scope(self) -> str:
        """Scope of the statistic as text, without chip and epoch; may be empty."""
        words = region_words(self.region)
        if self.relative:
            apart = "" if self.separation is None else f" up to {self.separation:g} px apart"
            words += f" between two positions{apart}"
        if self.magnitude is not None:
            words += f" of a star of magnitude {self.magnitude:g}"
        return words.strip()

    def reaches_beyond(self, covered: Coverage, grid: tuple[int, int]) -> bool:
        """True if the requirement is judged on parts of a chip that no stars cover.

        Parameters
        ----------
        covered : Coverage
            Coverage of a chip by stars.
        grid : tuple of int
            Number of points along x and y.

        Returns
        -------
        bool
            Always False if the uncovered part is not significant.
        """
        chip = covered.chip
        if not covered.significant or self.chip not in (None, chip.number):
            return False
        x, y = mesh(*grid_pixels(chip.size, grid))
        judged = in_region(self.region, chip.size, x, y)
        far = covered.beyond(x, y) > BEYOND_STARS.value * max(chip.size)
        return bool((judged & far).any())


def as_requirements(requirements: Requirement | Sequence[Requirement]) -> list[Requirement]:
    """Requirements as a list; a single requirement becomes a list of one.

    Raises
    ------
    InputError
        If one of them is not a `Requirement`.
    """
    several: list[Any] = [requirements]
    if isinstance(requirements, list | tuple):
        several = list(requirements)
    for requirement in several:
        if not isinstance(requirement, Requirement):
            raise InputError(
                f"{requirement!r} is not a requirement",
                where="requirements",
                do="give bayesdist.Requirement(name, statistic, limit)",
            )
    return several
