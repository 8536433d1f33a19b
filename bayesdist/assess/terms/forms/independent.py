"""Errors that are independent from position to position, and displacements that are none."""

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
    """Errors that are independent from position to position."""

    pools: ClassVar[tuple[Pool, ...]] = ()

    row: Row
    # standard deviations (N, 2) at the positions of a domain; None where there is no such error, as
    # of stars of no stated magnitude
    sigma: Callable[[EvaluationDomain], Float | None]
    # (n, 2), by chip number, what the variances of each draw are multiplied by; 1 where it is not
    # there
    sizes: Mapping[int, Float] = field(default_factory=dict)
    # by chip number: how well the size is known, relative to it
    known: Mapping[int, float | None] = field(default_factory=dict)

    def on(self, domain: EvaluationDomain, image: Image) -> NoiseField:
        """The errors at the positions of a domain."""
        sigma = self.sigma(domain)
        return NoiseField(() if sigma is None else (self.row,), domain, self, sigma)


@dataclass(frozen=True, eq=False)
class NoiseField(ErrorField):
    """Independent errors at the positions of a domain: no row where there are none."""

    of: Independent
    sigma: Float | None

    def squares(self) -> dict[str, Float]:
        """Mean squares of the row, if there is one."""
        return super().squares() if self.rows else {}

    def total(self) -> Float:
        """Variances (P, 2); of differences those of both positions."""
        pairs = self.domain.pairs()
        if self.sigma is None:
            return np.zeros((self.domain.size if pairs is None else pairs.shape[1], 2))
        square = self.sigma**2
        return square if pairs is None else square[pairs[0]] + square[pairs[1]]

    def relative_error(self, chip: int, monte_carlo: float) -> float | None:
        """As it was stated."""
        return self.of.known.get(chip)


@dataclass(frozen=True, eq=False)
class Known:
    """Displacements that are known, and no error."""

    pools: ClassVar[tuple[Pool, ...]] = ()

    row: Row  # in no total
    # takes pixels x, y (N,), a chip number and an epoch (or None) to (N, 2)
    shift: Callable[[Float, Float, int, float | None], Float]

    @property
    def rows(self) -> tuple[Row, ...]:
        """The row."""
        return (self.row,)

    def draw(self, n: int, rng: np.random.Generator) -> Known:
        """Itself: it is the same in every draw."""
        return self

    def on(self, domain: EvaluationDomain, image: Image) -> KnownField:
        """The displacements at the positions of a domain."""
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
        """Nothing."""
        return np.zeros_like(self.squares()[self.rows[0].name])

    def relative_error(self, chip: int, monte_carlo: float) -> float | None:
        """Known exactly."""
        return 0.0
