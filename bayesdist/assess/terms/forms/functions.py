"""Errors that are sums of arbitrary functions of the position."""

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

MANY = 64  # number of functions above which values are kept instead of coefficients


@dataclass(frozen=True, eq=False)
class Functions:
    """Sums of functions of the position; draw k uses row k mod n' of the coefficients."""

    row: Row
    # (n', 2, m) by chip number; a chip that is missing has no such error. The key None is for all
    # chips
    coefficients: Mapping[int | None, NDArray[np.floating]]
    # functions(chip_number, x, y) with pixels x, y (N,) returns values (N, m)
    functions: Callable[[int, Float, Float], NDArray[np.floating]]
    n_draws: int
    uniform: bool = False  # True if the error is the same at all positions
    # covariance (2, m, m) of the coefficients, if it is stated; mean squares are then exact, and
    # the uncertainty of their size is unknown
    covariance: Mapping[int | None, Float] | None = None
    pools: tuple[Pool, ...] = ()  # finite sets from which the coefficients are taken
    _cache: dict[EvaluationDomain, FunctionField] = field(default_factory=dict, repr=False)

    def on(self, domain: EvaluationDomain, image: Image) -> FunctionField:
        """Errors at the positions of a domain; the most recent ones are cached."""
        key = domain.at(None)
        if key not in self._cache:
            self._cache.clear()
            self._cache[key] = FunctionField((self.row,), key, self)
        return self._cache[key]

    def of(self, chip: int) -> NDArray[np.floating] | None:
        """Coefficients (n', 2, m) on a chip; None if there is no error."""
        return self.coefficients.get(chip, self.coefficients.get(None))

    def values(self, chip: int, x: Float, y: Float) -> NDArray[np.floating]:
        """Errors (n', N, 2) of all rows of coefficients, at pixels of a chip."""
        coefficients = self.of(chip)
        if coefficients is None:
            return np.zeros((1, len(x), 2))
        phi = self.functions(chip, x, y).astype(coefficients.dtype)
        # a single matrix product: 2000 products with two rows each take seven times as long
        errors = coefficients.reshape(-1, coefficients.shape[2]) @ phi.T
        return np.swapaxes(errors.reshape(-1, 2, len(phi)), 1, 2)


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
        """Number of rows of coefficients."""
        return max(len(values) for values, _ in self._parts)

    @property
    def uniform(self) -> bool:
        """True if the error is the same at all positions."""
        return self.of.uniform

    @cached_property
    def _parts(self) -> list[tuple[NDArray[np.floating], NDArray[np.floating] | None]]:
        """For each chip: coefficients and functions (N, m), or values if there are many."""
        at = self.domain
        out: list[tuple[NDArray[np.floating], NDArray[np.floating] | None]] = []
        for chip, rows in at.by_chip():
            x, y = at.x[rows], at.y[rows]
            coefficients = self.of.of(chip)
            if coefficients is None or coefficients.shape[2] > MANY:
                out.append((self.of.values(chip, x, y), None))
            else:
                out.append((coefficients, self.of.functions(chip, x, y)))
        return out

    def errors(self, draws: slice, scale: Scale) -> Float:
        """Errors (d, N, 2) of the draws in a slice."""
        parts = []
        for values, phi in self._parts:
            drawn = _of_draws(values, draws)
            parts.append(drawn if phi is None else np.swapaxes(drawn @ phi.T, 1, 2))
        out = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        size = scale.get(self.of.row.name, 1.0)
        return np.asarray(out if size == 1.0 else size * out, float)

    def total(self) -> Float:
        """Mean squares (P, 2), from the covariance or over all rows of coefficients."""
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
            chip_covariance = covariance[chip if chip in covariance else None]
            return np.asarray(np.einsum("nk,akl,nl->na", values, chip_covariance, values))

        pairs = at.pairs()
        if pairs is None:
            return np.concatenate([squares(values, chip) for chip, values in phi.items()])
        all_values, out = np.concatenate(list(phi.values())), np.empty((pairs.shape[1], 2))
        first, second = at.chip[pairs]
        for chip in phi:
            rows = first == chip
            same_chip = rows & ((second == chip) | (None in covariance))
            out[same_chip] = squares(
                all_values[pairs[1, same_chip]] - all_values[pairs[0, same_chip]], chip
            )
        apart = (first != second) & (None not in covariance)
        for side, chips in ((0, first), (1, second)):
            for chip in phi:
                rows = apart & (chips == chip)
                part = squares(all_values[pairs[side, rows]], chip)
                out[rows] = part if side == 0 else out[rows] + part
        return out

    def relative_error(self, chip: int, monte_carlo: float) -> float | None:
        """Relative scatter of the rms of each draw over the chip; None for a stated size."""
        if self.of.covariance is not None:
            return None
        model = self.domain.model
        size = model.chips[model.chip_code(chip)].size
        values = self.of.values(chip, *mesh(*grid_pixels(size, DEFAULT_GRID)))
        by_draw = np.sqrt(np.mean(np.square(values, dtype=float), axis=(1, 2)))
        mean = float(by_draw.mean())
        return float(by_draw.std()) / mean if mean > 0 else 0.0


def _of_draws(values: NDArray[np.floating], draws: slice) -> NDArray[np.floating]:
    """Rows (d, ...) of the draws in a slice: draw k is row k mod n'. A view if possible."""
    if draws.stop <= len(values):
        return values[draws]
    if len(values) == 1:
        return np.broadcast_to(values, (draws.stop - draws.start, *values.shape[1:]))
    return values[np.arange(draws.start, draws.stop) % len(values)]
