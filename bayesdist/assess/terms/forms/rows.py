"""Protocol of error terms: rows of a budget, draws, and error fields at positions.

A term is drawn once for all chips, epochs and questions. Its draws are evaluated at the positions
of any domain. Terms are independent of each other: correlated errors must be one term with several
rows.
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

BLOCK = 200_000  # number of positions times draws that are evaluated at a time


@dataclass(frozen=True)
class Row:
    """One row of an error budget."""

    name: str
    # 'systematic' (shared by all stars of an image), 'random' (independent for each star), 'local'
    # (shared by stars near a position) or 'product' (known deviation of a file, not an error)
    kind: str = "systematic"
    source: str = MEASURED  # begins with 'measured in this run', 'given by the user' or 'published'
    # False for a row that is only shown, because other rows already include it
    in_total: bool = True


@dataclass(frozen=True, eq=False)
class Image:
    """The image in which the position of a star is evaluated."""

    # (n,), code of the exposure in which each draw's star is observed; None for a new exposure, or
    # for a model without frames
    exposure: Int | None = None
    # (D,), parameters of the positions to which the observer has fitted shift and rotation of the
    # whole detector; None if there was no such fit
    aligned_by: Float | None = None


@dataclass(frozen=True, eq=False)
class Pool:
    """Finite set of draws from which those of a term are taken, possibly with repetitions.

    Drawing more often than this does not make a probability more precise, except for the part
    that other terms contribute.
    """

    # (n,), number within the set of each draw of the term; None if it is unknown
    rows: Int | None
    size: float  # effective number of independent draws in the set
    renewed: bool = False  # True if further draws of the term are taken from another set


class ErrorTerm(Protocol):
    """A contribution to the error of a position; every error term implements this protocol."""

    @property
    def rows(self) -> tuple[Row, ...]:
        """Rows of the budget."""
        ...

    def draw(self, n: int, rng: np.random.Generator) -> ErrorDraws:
        """Draw the error n times; each draw applies to all chips and epochs."""
        ...


class ErrorDraws(Protocol):
    """Draws of a term; the forms of this package implement this protocol."""

    @property
    def pools(self) -> tuple[Pool, ...]:
        """Finite sets from which the draws are taken; empty if each draw is independent."""
        ...

    def on(self, domain: EvaluationDomain, image: Image) -> ErrorField:
        """Errors at the positions of a domain, in an image."""
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
        """Mean squares (P, 2) of each row, at positions or of the differences of pairs."""
        (row,) = self.rows
        return {row.name: self.total()}

    @abstractmethod
    def total(self) -> Float:
        """Mean squares (P, 2) of the sum of all rows."""

    @property
    def parts(self) -> tuple[ErrorField, ...]:
        """Fields of the single rows."""
        return (self,)

    @property
    def summed(self) -> tuple[ErrorField, ...]:
        """Fields that sum to the error."""
        return (self,)

    def by_row(self) -> Iterator[tuple[Row, ErrorField, Float]]:
        """Each row with its field and its mean squares (P, 2)."""
        squares = self.squares()
        for part in self.parts:
            for row in part.rows:
                yield row, part, squares[row.name]

    def relative_error(self, chip: int, monte_carlo: float) -> float | None:
        """Relative uncertainty of the size of a single row on a chip; None if it is unknown."""
        return monte_carlo


class DrawnField(ErrorField):
    """Errors that can be evaluated for every draw at the positions of a domain."""

    @property
    @abstractmethod
    def n_draws(self) -> int:
        """Number of draws."""

    @property
    def n_different(self) -> int:
        """Number of different draws; further ones repeat them in order."""
        return self.n_draws

    @abstractmethod
    def errors(self, draws: slice, scale: Scale) -> Float:
        """Errors (d, N, 2) of the draws in a slice, with rows multiplied by factors."""

    def total(self) -> Float:
        """Mean squares (P, 2) of the sum of all rows."""
        return self.by_draws(slice(0, self.n_different))

    def by_draws(self, draws: slice) -> Float:
        """Mean squares (P, 2) over the draws in a slice, evaluated in blocks."""
        pairs, total, n = self.domain.pairs(), 0.0, draws.stop - draws.start
        step = max(1, BLOCK // max(self.domain.size, 1))
        for start in range(draws.start, draws.stop, step):
            errors = self.errors(slice(start, min(start + step, draws.stop)), {})
            if pairs is not None:
                errors = errors[:, pairs[1]] - errors[:, pairs[0]]
            total = total + np.einsum("dna,dna->na", errors, errors)
        return np.asarray(total / n)
