"""The protocol of error terms: rows of a budget, draws, and fields of these at positions.

A term draws its chance once, for all chips, epochs and questions; its draws are evaluated at the
positions of a domain wherever they are asked for.  Terms are independent of each other: what is
correlated is one term with several rows.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.utils.arrays import Float, Int

Scale = Mapping[str, float]

LOCAL, PRODUCT = "local", "product"
MEASURED, GIVEN, PUBLISHED = "measured in this run", "given by the user", "published"

BLOCK = 200_000  # positions times draws that are evaluated at once


@dataclass(frozen=True)
class Row:
    """One row of a budget."""

    name: str
    # 'systematic' (shared by all stars of an image), 'random' (of each star), 'local' (shared by
    # the stars near a position) or 'product' (of a file: known, and no error)
    kind: str = "systematic"
    source: str = MEASURED  # begins with 'measured in this run', 'given by the user' or 'published'
    # false for a row that is shown beside the others, as these hold it already
    in_total: bool = True


@dataclass(frozen=True, eq=False)
class Image:
    """In which image a position is asked for."""

    # (n,), code of the exposure in which the star of each draw lies; None for a new exposure, or
    # one of a model without frames
    exposure: Int | None = None
    # (D,), parameters of the positions to which the observer has fitted shift and rotation of the
    # whole detector; None where nobody has
    aligned_by: Float | None = None


@dataclass(frozen=True, eq=False)
class Pool:
    """Finite set of draws from which those of a term are taken, some of them more than once.

    More draws than these make a probability no better known, except for what other terms add.
    """

    # (n,), which draw of the set each draw of the term is; None where that is not known
    rows: Int | None
    size: float  # independent draws that the whole set is worth
    renewed: bool = False  # True if further draws of the term are taken from another set


class ErrorTerm(Protocol):
    """Something that moves positions: all that a new one has to give."""

    @property
    def rows(self) -> tuple[Row, ...]:
        """Rows of the budget."""
        ...

    def draw(self, n: int, rng: np.random.Generator) -> ErrorDraws:
        """Draws of the error, one chance for all chips and epochs."""
        ...


class ErrorDraws(Protocol):
    """Draws of a term: one of the forms of this module."""

    @property
    def pools(self) -> tuple[Pool, ...]:
        """Finite sets that the draws are taken from; empty where each draw is a new one."""
        ...

    def on(self, domain: EvaluationDomain, image: Image) -> ErrorField:
        """The errors at the positions of a domain."""
        ...


@dataclass(frozen=True, eq=False)
class ErrorField(ABC):
    """Errors of a term at the N positions of a domain."""

    rows: tuple[Row, ...]
    domain: EvaluationDomain

    of_parameters: ClassVar[bool] = False  # True for errors of parameters

    @property
    def uniform(self) -> bool:
        """True if the error is the same at all positions."""
        return False

    def squares(self) -> dict[str, Float]:
        """Mean squares (P, 2) of each row: at positions, or of the differences of pairs."""
        (row,) = self.rows
        return {row.name: self.total()}

    @abstractmethod
    def total(self) -> Float:
        """Mean squares (P, 2) of all rows together."""

    @property
    def parts(self) -> tuple[ErrorField, ...]:
        """Fields of single rows."""
        return (self,)

    @property
    def summed(self) -> tuple[ErrorField, ...]:
        """Fields whose sum is the error."""
        return (self,)

    def by_row(self) -> Iterator[tuple[Row, ErrorField, Float]]:
        """Each row, with its own field and its mean squares (P, 2)."""
        squares = self.squares()
        for part in self.parts:
            for row in part.rows:
                yield row, part, squares[row.name]

    def relative_error(self, chip: int, monte_carlo: float) -> float | None:
        """Relative error of the size of a single row on a chip; None where it is not known."""
        return monte_carlo


class DrawnField(ErrorField):
    """Errors that are the same at all positions of a draw, or vary over them as it says."""

    @property
    @abstractmethod
    def n_draws(self) -> int:
        """Number of draws."""

    @property
    def n_different(self) -> int:
        """Draws after which they are the first ones again."""
        return self.n_draws

    @abstractmethod
    def errors(self, draws: slice, scale: Scale) -> Float:
        """Errors (d, N, 2) of some draws, rows multiplied by factors."""

    def total(self) -> Float:
        """Mean squares (P, 2) of all rows together."""
        return self.by_draws(slice(0, self.n_different))

    def by_draws(self, draws: slice) -> Float:
        """Mean squares (P, 2) over some draws, evaluated in blocks."""
        pairs, total, n = self.domain.pairs(), 0.0, draws.stop - draws.start
        step = max(1, BLOCK // max(self.domain.size, 1))
        for start in range(draws.start, draws.stop, step):
            errors = self.errors(slice(start, min(start + step, draws.stop)), {})
            if pairs is not None:
                errors = errors[:, pairs[1]] - errors[:, pairs[0]]
            total = total + np.einsum("dna,dna->na", errors, errors)
        return np.asarray(total / n)
