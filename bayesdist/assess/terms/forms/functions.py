"""Errors that are sums of functions of the position, of any shape."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.terms.forms.rows import DrawnField, Image, Pool, Row, Scale
from bayesdist.model.grid import DEFAULT_GRID, grid_pixels, mesh
from bayesdist.utils.arrays import Float

MANY = 64  # functions from which on their values are kept, not their coefficients alone


@dataclass(frozen=True, eq=False)
class Functions:
    """Errors that are sums of functions of the position: draw k is row k mod n' of coefficients."""

    row: Row
    # (n', 2, m), by chip number; a chip that is not there has no such error. Under None, those of
    # all chips
    coefficients: Mapping[int | None, NDArray[np.floating]]
    # take a chip number and pixels x, y (N,) to values (N, m)
    functions: Callable[[int, Float, Float], NDArray[np.floating]]
    n_draws: int
    uniform: bool = False  # whether the error is the same at all positions
    # (2, m, m), of the coefficients, where it is stated: mean squares are exact then, and it is not
    # known how well their size is
    covariance: Mapping[int | None, Float] | None = None
    pools: tuple[Pool, ...] = ()  # finite sets that the coefficients are taken from
    _cache: dict[EvaluationDomain, FunctionField] = field(default_factory=dict, repr=False)

    def on(self, domain: EvaluationDomain, image: Image) -> FunctionField:
        """The errors at the positions of a domain; of those asked for last they are kept."""
        key = domain.at(None)
        if key not in self._cache:
            self._cache.clear()
            self._cache[key] = FunctionField((self.row,), key, self)
        return self._cache[key]

    def of(self, chip: int) -> NDArray[np.floating] | None:
        """Coefficients (n', 2, m) on a chip; None where there is no error."""
        return self.coefficients.get(chip, self.coefficients.get(None))

    def values(self, chip: int, x: Float, y: Float) -> NDArray[np.floating]:
        """Errors (n', N, 2) of all rows at pixels of a chip."""
        own = self.of(chip)
        if own is None:
            return np.zeros((1, len(x), 2))
        phi = self.functions(chip, x, y).astype(own.dtype)
        # one product of matrices: 2000 of two rows each take seven times as long
        both = own.reshape(-1, own.shape[2]) @ phi.T
        return np.swapaxes(both.reshape(-1, 2, len(phi)), 1, 2)


@dataclass(frozen=True, eq=False)
class FunctionField(DrawnField):
    """Sums of functions at the positions of a domain."""

    of: Functions

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return self.of.n_draws

    @property
    def n_different(self) -> int:
        """Rows of coefficients."""
        return max(len(values) for values, _ in self._parts)

    @property
    def uniform(self) -> bool:
        """True if the error is the same at all positions."""
        return self.of.uniform

    @cached_property
    def _parts(self) -> list[tuple[NDArray[np.floating], NDArray[np.floating] | None]]:
        """Coefficients with functions (N, m) of each chip, or values where these are many."""
        at = self.domain
        out: list[tuple[NDArray[np.floating], NDArray[np.floating] | None]] = []
        for chip, rows in at.by_chip():
            x, y = at.x[rows], at.y[rows]
            own = self.of.of(chip)
            if own is None or own.shape[2] > MANY:
                out.append((self.of.values(chip, x, y), None))
            else:
                out.append((own, self.of.functions(chip, x, y)))
        return out

    def errors(self, draws: slice, scale: Scale) -> Float:
        """Errors (d, N, 2) of some draws."""
        parts = []
        for values, phi in self._parts:
            some = _of_draws(values, draws)
            parts.append(some if phi is None else np.swapaxes(some @ phi.T, 1, 2))
        out = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        size = scale.get(self.of.row.name, 1.0)
        return np.asarray(out if size == 1.0 else size * out, float)

    def total(self) -> Float:
        """Mean squares (P, 2): by the covariance, or over all rows of coefficients."""
        if self.of.covariance is not None:
            return self._stated(self.of.covariance)
        return super().total()

    def _stated(self, covariance: Mapping[int | None, Float]) -> Float:
        at, functions = self.domain, self.of.functions
        phi = {
            chip: np.asarray(functions(chip, at.x[rows], at.y[rows]), float)
            for chip, rows in at.by_chip()
        }

        def squares(values: Float, chip: int) -> Float:
            own = covariance[chip if chip in covariance else None]
            return np.asarray(np.einsum("nk,akl,nl->na", values, own, values))

        pairs = at.pairs()
        if pairs is None:
            return np.concatenate([squares(values, chip) for chip, values in phi.items()])
        every, out = np.concatenate(list(phi.values())), np.empty((pairs.shape[1], 2))
        first, second = at.chip[pairs]
        for chip in phi:
            rows = first == chip
            same = rows & ((second == chip) | (None in covariance))
            out[same] = squares(every[pairs[1, same]] - every[pairs[0, same]], chip)
        apart = (first != second) & (None not in covariance)
        for side, chips in ((0, first), (1, second)):
            for chip in phi:
                rows = apart & (chips == chip)
                part = squares(every[pairs[side, rows]], chip)
                out[rows] = part if side == 0 else out[rows] + part
        return out

    def relative_error(self, chip: int, monte_carlo: float) -> float | None:
        """As the rms of each draw over the chip scatters, where the size was measured."""
        if self.of.covariance is not None:
            return None
        model = self.domain.model
        size = model.chips[model.chip_code(chip)].size
        values = self.of.values(chip, *mesh(*grid_pixels(size, DEFAULT_GRID)))
        by_draw = np.sqrt(np.mean(np.square(values, dtype=float), axis=(1, 2)))
        mean = float(by_draw.mean())
        return float(by_draw.std()) / mean if mean > 0 else 0.0


def _of_draws(values: NDArray[np.floating], draws: slice) -> NDArray[np.floating]:
    """Rows (d, ...) of some draws: row k mod n' is that of draw k.  They are copied if need be."""
    if draws.stop <= len(values):
        return values[draws]
    if len(values) == 1:
        return np.broadcast_to(values, (draws.stop - draws.start, *values.shape[1:]))
    return values[np.arange(draws.start, draws.stop) % len(values)]
