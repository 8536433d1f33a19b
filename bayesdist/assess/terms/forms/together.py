"""Correlated rows of one term, which use the same draw number."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.terms.forms.functions import Functions
from bayesdist.assess.terms.forms.polynomials import Polynomials
from bayesdist.assess.terms.forms.rows import DrawnField, Image, Pool, Scale
from bayesdist.utils.arrays import Float


@dataclass(frozen=True, eq=False)
class Together:
    """Correlated rows of one term, which use the same draw number.

    The joint error is the sum of the rows that are in the total. It already includes the rows that
    are not: if one of these is reduced, the variance of the joint error decreases at each position
    by the variance that the row loses.
    """

    draws: tuple[Polynomials | Functions, ...]  # one for each row
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
        """Field with the rows of all parts."""
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
        """Joint error (d, N, 2) of the draws in a slice, each row multiplied by its factor."""
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
