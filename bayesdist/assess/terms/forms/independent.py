"""Errors that are independent between positions, and known displacements."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.terms.forms.rows import ErrorField, Image, Pool, Row
from bayesdist.utils.arrays import Float


@dataclass(frozen=True, eq=False)
class Independent:
    """Errors that are independent between positions."""

    pools: ClassVar[tuple[Pool, ...]] = ()

    row: Row
    # standard deviations (N, 2) at the positions of a domain; None if there is no such error, for
    # example for stars without a magnitude
    sigma: Callable[[EvaluationDomain], Float | None]
    # factors (n, 2) of the variances of each draw, by chip number; 1 for a chip that is missing
    sizes: Mapping[int, Float] = field(default_factory=dict)
    # relative uncertainty of the size, by chip number
    known: Mapping[int, float | None] = field(default_factory=dict)

    def on(self, domain: EvaluationDomain, image: Image) -> NoiseField:
        """Errors at the positions of a domain."""
        sigma = self.sigma(domain)
        return NoiseField(() if sigma is None else (self.row,), domain, self, sigma)


@dataclass(frozen=True, eq=False)
class NoiseField(ErrorField):
    """Independent errors at the positions of a domain; without a row if there are none."""

    of: Independent
    sigma: Float | None

    def squares(self) -> dict[str, Float]:
        """Mean squares of the row, if any."""
        return super().squares() if self.rows else {}

    def total(self) -> Float:
        """Variances (P, 2); for differences, the sum of the variances of both positions."""
        pairs = self.domain.pairs()
        if self.sigma is None:
            return np.zeros((self.domain.size if pairs is None else pairs.shape[1], 2))
        square = self.sigma**2
        return square if pairs is None else square[pairs[0]] + square[pairs[1]]

    def relative_error(self, chip: int, monte_carlo: float) -> float | None:
        """Stated relative error; None if it is unknown."""
        return self.of.known.get(chip)


@dataclass(frozen=True, eq=False)
class Known:
    """Known displacements, which are not errors."""

    pools: ClassVar[tuple[Pool, ...]] = ()

    row: Row  # not included in any total
    # shift(x, y, chip_number, epoch) with pixels x, y (N,) and epoch or None returns (N, 2)
    shift: Callable[[Float, Float, int, float | None], Float]

    @property
    def rows(self) -> tuple[Row, ...]:
        """A single row."""
        return (self.row,)

    def draw(self, n: int, rng: np.random.Generator) -> Known:
        """Return this object: displacements are the same in every draw."""
        return self

    def on(self, domain: EvaluationDomain, image: Image) -> KnownField:
        """Displacements at the positions of a domain."""
        parts = [
            self.shift(domain.x[rows], domain.y[rows], chip, domain.epoch)
            for chip, rows in domain.by_chip()
        ]
        return KnownField((self.row,), domain, np.concatenate(parts))


@dataclass(frozen=True, eq=False)
class KnownField(ErrorField):
    """Displacements (N, 2) at the positions of a domain."""

    shift: Float

    def squares(self) -> dict[str, Float]:
        """Squares of the displacements, or of their differences."""
        pairs = self.domain.pairs()
        moved = self.shift if pairs is None else self.shift[pairs[1]] - self.shift[pairs[0]]
        return {self.rows[0].name: moved**2}

    def total(self) -> Float:
        """Zeros, because displacements are not errors."""
        return np.zeros_like(self.squares()[self.rows[0].name])

    def relative_error(self, chip: int, monte_carlo: float) -> float | None:
        """Zero, because displacements are exact."""
        return 0.0
