"""A requirement on the position error: which statistic, where, when, and how surely."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

from bayesdist.assess.domain import (
    WHOLE,
    Region,
    check_region,
    in_region,
    region_words,
)
from bayesdist.assess.statistics import STATISTICS
from bayesdist.assess.units import UNITS, stated_unit
from bayesdist.diagnose.residuals.coverage import Coverage
from bayesdist.errors import InputError, require_known
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.utils.limits import BEYOND_STARS
from bayesdist.utils.quantities import unit_name, value_in, year_of


@dataclass(frozen=True)
class Requirement:
    """A limit on a statistic of the position error over the detector, which is all of its chips.

    Parameters
    ----------
    name : str
    statistic : str
        One of `STATISTICS`.
    limit : float or Quantity
        Positive; stored as a number in `unit`.
    unit : str, optional
        'pix', 'arcsec', 'mas' or 'deg'; of a Quantity it is its own.  It may be left out (empty)
        for models whose u and v are in pixels: see `in_unit_of`.
    probability : float
        With which the statistic must be at or under the limit, between 0 and 1.
    epoch : float, str, Time, date or Quantity, optional
        Stored in decimal years.
    chip : int, optional
        Number of the one chip that is judged; all chips together by default.
    region : str or sequence of (x, y)
        The part of each chip that counts: see `check_region`.
    epochs : tuple of float, optional
        First and last epoch of a range, in place of `epoch`: the limit must hold throughout.
    relative : bool
        Whether the error is that of the difference of two positions in one image, over all pairs of
        positions, in place of that of one position.
    separation : float or Quantity, optional
        Pairs on one chip that are not farther apart than so many pixels; for relative errors.
    magnitude : float or Quantity, optional
        Of the star whose error is meant: its centroid's error counts in.

    Raises
    ------
    InputError
        For an unknown statistic, unit or region, and for numbers out of range or at odds.

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
        # a plain number is the same in any unit
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
            years = tuple(year_of(one, "epochs", where=self.where) for one in self.epochs)
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
                "a separation is of two positions, and the error is that of one",
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
        """Requirement with a unit: its own, or pixels if those are the unit of u and v.

        Parameters
        ----------
        unit : str
            Of u and v.

        Returns
        -------
        Requirement

        Raises
        ------
        InputError
            If it has no unit, and u and v are in angles.
        """
        return self if self.unit else replace(self, unit=stated_unit(self.unit, unit, self.where))

    @property
    def where(self) -> str:
        """Name in messages."""
        return f"requirement {self.name!r}"

    @property
    def scope(self) -> str:
        """Words on the scope of the statistic beside chip and epoch; may be empty."""
        words = region_words(self.region)
        if self.relative:
            apart = "" if self.separation is None else f" up to {self.separation:g} px apart"
            words += f" between two positions{apart}"
        if self.magnitude is not None:
            words += f" of a star of magnitude {self.magnitude:g}"
        return words.strip()

    def reaches_beyond(self, covered: Coverage, grid: tuple[int, int]) -> bool:
        """True if the requirement is judged on a chip where there are no stars.

        Parameters
        ----------
        covered : Coverage
            Of the chip.
        grid : tuple of int
            Points on x and y.

        Returns
        -------
        bool
            Only where what is not covered is significant.
        """
        chip = covered.chip
        if not covered.significant or self.chip not in (None, chip.number):
            return False
        x, y = mesh(*grid_pixels(chip.size, grid))
        judged = in_region(self.region, chip.size, x, y)
        far = covered.beyond(x, y) > BEYOND_STARS.value * max(chip.size)
        return bool((judged & far).any())


def as_requirements(requirements: Requirement | Sequence[Requirement]) -> list[Requirement]:
    """Requirements as a list; one requirement alone becomes a list of one.

    Raises
    ------
    InputError
        If one of them is something else.
    """
    several: list[Any] = [requirements]
    if isinstance(requirements, list | tuple):
        several = list(requirements)
    for requirement in several:
        if not isinstance(requirement, Requirement):
            raise InputError(
                f"{requirement!r} is no requirement",
                where="requirements",
                do="give bayesdist.Requirement(name, statistic, limit)",
            )
    return several
