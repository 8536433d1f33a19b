"""Protocol of error terms, and the forms in which their errors are drawn.

A term is drawn once for all chips, epochs and questions. Its draws are evaluated at the positions
of any domain. Terms are independent of each other: correlated errors must be one term with several
rows.

`draw` of a term returns one of these forms:

- `Polynomials` and `Functions` (`bayesdist.assess.terms.functions`): errors that are functions of
  the position;
- `Independent`: errors that are independent between positions;
- `Known`: displacements, which are not errors;
- `Together`: correlated rows of one term, which use the same draw number.

A form is evaluated at the positions of a domain by its method `on`, which returns an `ErrorField`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, reduce
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.model import DistortionModel
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
        """Rows of the error budget to which the term contributes, in a fixed order."""
        ...

    def draw(self, n: int, rng: np.random.Generator) -> ErrorDraws:
        """Draw the error n times; each draw applies to all chips and epochs.

        Parameters
        ----------
        n : int
            Number of draws.
        rng : numpy.random.Generator
            Source of all random numbers of the term.

        Returns
        -------
        ErrorDraws
            Draws in the unit of u and v.
        """
        ...


@runtime_checkable
class VaryingTerm(ErrorTerm, Protocol):
    """A term of unknown extent: an error of the whole field, or one that varies over it."""

    @property
    def varies(self) -> bool | None:
        """True if the error may vary over the field; None is taken as False."""
        ...

    def treatments(
        self, model: DistortionModel, grid: tuple[int, int] | None
    ) -> tuple[ErrorTerm, ...]:
        """The error as a smooth field and as independent errors; empty if it cannot vary.

        `grid`: number of points along x and y of each chip over which the smooth field has its
        stated rms; None for the default grid.
        """
        ...


@runtime_checkable
class AmbiguousTerm(ErrorTerm, Protocol):
    """A term whose cause is unknown if the data fit two causes."""

    @property
    def alternative(self) -> ErrorTerm | None:
        """The error if it has the other cause; None if the cause is known."""
        ...


@runtime_checkable
class SizedTerm(ErrorTerm, Protocol):
    """A term whose size the user states as one number."""

    @property
    def sigma(self) -> float:
        """Standard deviation, in the unit of the term; 0 if there is no error."""
        ...


class ErrorDraws(Protocol):
    """Draws of a term; the forms of this package implement this protocol."""

    @property
    def pools(self) -> tuple[Pool, ...]:
        """Finite sets from which the draws are taken; empty if each draw is independent."""
        ...

    def on(self, domain: EvaluationDomain, image: Image) -> ErrorField:
        """Errors at the positions of a domain, for a star in the given image."""
        ...


@dataclass(frozen=True, eq=False)
class ErrorField(ABC):
    """Errors of a term at the N positions of a domain.

    Mean squares have shape (P, 2), for u and v.  P is N for errors of positions, and the number of
    pairs if the domain is for differences between positions.
    """

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
        """Relative uncertainty of the size of a single row on a chip; None if it is unknown.

        `monte_carlo` is that of a standard deviation from the draws, because their number is
        finite.
        """
        return monte_carlo


class DrawnField(ErrorField):
    """Errors that can be evaluated for every draw at the positions of a domain."""

    @property
    @abstractmethod
    def n_draws(self) -> int:
        """Number of draws, including repeated ones."""

    @property
    def n_different(self) -> int:
        """Number of different draws; further ones repeat them in order."""
        return self.n_draws

    @abstractmethod
    def errors(self, draws: slice, scale: Scale) -> Float:
        """Errors (d, N, 2) of the d draws in a slice.

        `scale` has factors by which rows are multiplied, by name of the row; missing rows have the
        factor 1.
        """

    def total(self) -> Float:
        """Mean squares (P, 2) of the sum of all rows."""
        return self.by_draws(slice(0, self.n_different))

    def by_draws(self, draws: slice) -> Float:
        """Mean squares (P, 2) over the draws in a slice.

        The errors are evaluated in blocks of draws, to limit memory.
        """
        pairs, total, n = self.domain.pairs(), 0.0, draws.stop - draws.start
        step = max(1, BLOCK // max(self.domain.size, 1))
        for start in range(draws.start, draws.stop, step):
            errors = self.errors(slice(start, min(start + step, draws.stop)), {})
            if pairs is not None:
                errors = errors[:, pairs[1]] - errors[:, pairs[0]]
            total = total + np.einsum("dna,dna->na", errors, errors)
        return np.asarray(total / n)


class EvaluatedDraws(ErrorDraws, Protocol):
    """Draws that can be evaluated one by one at the positions of a domain."""

    def on(self, domain: EvaluationDomain, image: Image) -> DrawnField:
        """Errors at the positions of a domain, for a star in the given image."""
        ...


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
        """Mean squares (P, 2) of the row by its name; empty if there is no row."""
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
        """Row of the displacements."""
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
        """Squares (P, 2) of the displacements, or of their differences, by name of the row."""
        pairs = self.domain.pairs()
        moved = self.shift if pairs is None else self.shift[pairs[1]] - self.shift[pairs[0]]
        return {self.rows[0].name: moved**2}

    def total(self) -> Float:
        """Zeros (P, 2), because displacements are not errors."""
        return np.zeros_like(self.squares()[self.rows[0].name])

    def relative_error(self, chip: int, monte_carlo: float) -> float | None:
        """Zero, because displacements are exact."""
        return 0.0


@dataclass(frozen=True, eq=False)
class Together:
    """Correlated rows of one term, which use the same draw number.

    The joint error is the sum of the rows that are in the total. It already includes the rows that
    are not: if one of these is reduced, the variance of the joint error decreases at each position
    by the variance that the row loses.
    """

    draws: tuple[EvaluatedDraws, ...]  # one for each row
    # True if the last row is the excess of the joint error over the other rows
    remainder: bool = False

    @property
    def pools(self) -> tuple[Pool, ...]:
        """Finite sets from which the draws of the rows are taken."""
        return tuple(pool for draws in self.draws for pool in draws.pools)

    def on(self, domain: EvaluationDomain, image: Image) -> TogetherField:
        """Errors at the positions of a domain."""
        parts = tuple(draws.on(domain, image) for draws in self.draws)
        return TogetherField.of(domain, parts, remainder=self.remainder)


@dataclass(frozen=True, eq=False)
class TogetherField(DrawnField):
    """Rows of one term at the positions of a domain."""

    members: tuple[DrawnField, ...]
    whole: DrawnField | None = None  # the joint error, if it is more than the sum of the rows
    remainder: bool = False  # see `Together`

    @classmethod
    def of(
        cls,
        domain: EvaluationDomain,
        parts: tuple[DrawnField, ...],
        whole: DrawnField | None = None,
        *,
        remainder: bool = False,
    ) -> TogetherField:
        """Field with the rows of all parts.

        `whole` is the joint error, if it is not the sum of the rows, and `remainder` is explained
        in `Together`.
        """
        rows = tuple(row for part in parts for row in part.rows)
        return cls(rows, domain, parts, whole, remainder)

    @property
    def parts(self) -> tuple[DrawnField, ...]:
        """A field for each row."""
        return self.members

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return self.members[0].n_draws

    @cached_property
    def summed(self) -> tuple[DrawnField, ...]:
        """Fields that sum to the joint error."""
        return self._added if self.whole is None else (self.whole,)

    @cached_property
    def _added(self) -> tuple[DrawnField, ...]:
        """Parts that are in the total."""
        return tuple(p for p in self.members if all(row.in_total for row in p.rows))

    def errors(self, draws: slice, scale: Scale) -> Float:
        """Joint errors (d, N, 2) of a slice of the draws; `scale` has factors for rows, by name."""
        if self.whole is None:
            out = reduce(np.add, (part.errors(draws, scale) for part in self._added))
        else:
            out = self.whole.errors(draws, {})
            for part in self._added:
                sizes = [scale[row.name] for row in part.rows if row.name in scale]
                if sizes:
                    out = out - (1.0 - sizes[0]) * part.errors(draws, {})
        factor = self._factor(scale)
        return out if factor is None else factor * out

    def _factor(self, scale: Scale) -> Float | None:
        """Factor (N, 2) of the joint error if rows that it includes are reduced."""
        held = [r.name for r in self.rows if not r.in_total and r.name in scale]
        if not held:
            return None
        assert not self.domain.relative
        total, by_row = self.total(), self.squares()
        remaining = total - sum(
            (1.0 - scale[name] ** 2) * np.minimum(by_row[name], total) for name in held
        )
        return np.sqrt(np.maximum(remaining, 0.0) / np.where(total > 0, total, 1.0))

    def squares(self) -> dict[str, Float]:
        """Mean squares (P, 2) of each row."""
        return self._squares

    @cached_property
    def _squares(self) -> dict[str, Float]:
        out: dict[str, Float] = {}
        for part in self.members:
            out |= part.squares()
        if self.remainder:
            last = self.rows[-1].name
            other_rows = sum(square for name, square in out.items() if name != last)
            out[last] = np.maximum(self.total() - other_rows, 0.0)
        return out

    @cached_property
    def _total(self) -> Float:
        if self.whole is not None:
            return self.whole.total()
        if len(self._added) == 1:
            return self._added[0].total()
        return self.by_draws(slice(0, min(part.n_different for part in self._added)))

    def total(self) -> Float:
        """Mean squares (P, 2) of the joint error."""
        return self._total
