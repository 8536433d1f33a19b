"""Draws of all errors of a position, and their statistics over parts of the detector.

Requirements, epochs, parts of the detector and questions such as "what if this term were half as
large" are all answered with the same draws. Differences between answers are therefore free of
Monte-Carlo noise.
"""

from __future__ import annotations

import os
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from bayesdist.assess.domain import EvaluationDomain, WorstPosition, extent, of_sizes, sizes
from bayesdist.assess.terms.forms import (
    PRODUCT,
    DrawnField,
    ErrorDraws,
    ErrorField,
    ErrorTerm,
    Image,
    NoiseField,
    Pool,
    VaryingTerm,
)
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.solution.solution import Solution
from bayesdist.utils.arrays import Float

ROWS = 16  # draws per random generator of the noise, so that it does not depend on the blocks
BLOCK = 60_000  # positions times draws per thread at a time, which fit into the processor's cache
EPOCHS = 8  # number of epochs with their polynomials in memory at the same time
MOST_PAIRS = 5000  # sampled pairs of positions, which give percentiles over all pairs to about 1 %


def generators(terms: Sequence[ErrorTerm], seed: int) -> list[np.random.Generator]:
    """Random generator of each term, seeded with `seed` and the name of its first row.

    Terms of equal name are numbered. The draws of a term do not depend on the other terms.
    """
    occurrences: Counter[str] = Counter()
    out = []
    for term in terms:
        name = term.rows[0].name
        out.append(np.random.default_rng([seed, zlib.crc32(name.encode()), occurrences[name]]))
        occurrences[name] += 1
    return out


@dataclass(frozen=True, eq=False)
class DrawnErrors:
    """Draws of all errors of a position."""

    solution: Solution
    terms: tuple[ErrorTerm, ...]
    draws: tuple[ErrorDraws, ...]  # one for each term
    image: Image
    n_draws: int
    seed: int  # for the terms, and for errors that are independent between positions
    # further(n, number): n more draws of the same errors, another set for each number from 1 on
    further: Callable[[int, int], DrawnErrors] | None = None
    block: int = BLOCK  # positions times draws that each thread evaluates at a time
    _cache: dict[EvaluationDomain, tuple[ErrorField, ...]] = field(default_factory=dict, repr=False)

    @property
    def unit(self) -> str:
        """Unit of all errors."""
        return self.solution.model.unit

    @property
    def n_effective(self) -> float:
        """Effective number of independent draws (a lower bound); at least 1.

        Taking n draws from a finite set that is equivalent to m independent draws, such as a chain,
        adds the Monte-Carlo variance of the set to that of the drawing. The fractions that several
        sets contribute to the variance of a probability sum to at most 1. Hence 1 / n_eff is at
        most 1 / n + 1 / m for the smallest m.
        """
        smallest = min((pool.size for pool in self.pools), default=np.inf)
        return max(1.0 / (1.0 / self.n_draws + 1.0 / smallest), 1.0)

    @property
    def pools(self) -> tuple[Pool, ...]:
        """Finite sets that draws of the terms are taken from."""
        return tuple(pool for draws in self.draws for pool in draws.pools)

    def at(self, domain: EvaluationDomain) -> tuple[ErrorField, ...]:
        """Errors of each term at the positions of a domain."""
        if domain not in self._cache:
            self._cache[domain] = tuple(draws.on(domain, self.image) for draws in self.draws)
        return self._cache[domain]

    def treatments(self, grid: tuple[int, int] | None) -> tuple[DrawnErrors, ...]:
        """Draws in which every term that may vary over the field does so.

        Returns two variants: as smooth fields, and independently at every position.  The result is
        empty if no term may vary.

        `grid`: number of points along x and y over which a smooth field has its stated size.
        """
        model = self.solution.model
        variants = [
            (term.treatments(model, grid) if isinstance(term, VaryingTerm) else ()) or (term, term)
            for term in self.terms
        ]
        if all(pair == (term, term) for pair, term in zip(variants, self.terms, strict=True)):
            return ()
        return tuple(self.with_terms(choice) for choice in zip(*variants, strict=True))

    def with_terms(self, terms: tuple[ErrorTerm, ...]) -> DrawnErrors:
        """Draws of other terms in place of these, one for each; equal terms keep their draws."""
        random = generators(terms, self.seed)
        draws = tuple(
            old if new is term else new.draw(self.n_draws, rng)
            for old, term, new, rng in zip(self.draws, self.terms, terms, random, strict=True)
        )
        return replace(self, terms=terms, draws=draws, further=None, _cache={})

    def statistics(
        self,
        domain: EvaluationDomain,
        names: Sequence[str],
        *,
        scale: Mapping[str, float] | None = None,
        n_draws: int | None = None,
    ) -> dict[str, Float]:
        """Statistics of the error field of each draw, over positions or over pairs of them.

        `names`: names in `STATISTICS`. `scale`: factors by which rows are multiplied. `n_draws`:
        number of draws to use, from the first; all by default. Returns an array (n_draws,) for each
        name. Raises InputError if no pair of positions is close enough, if the domain has a
        magnitude but no errors by magnitude are known, or if the epoch is missing.
        """
        (statistics,) = self._together(domain, (domain.epoch,), names, scale, n_draws)
        return statistics

    def over_epochs(
        self,
        domain: EvaluationDomain,
        epochs: Sequence[float | None],
        names: Sequence[str],
        *,
        scale: Mapping[str, float] | None = None,
        n_draws: int | None = None,
        at_once: int = EPOCHS,
    ) -> tuple[dict[str, Float], ...]:
        """Statistics at several epochs, faster than with one call per epoch.

        `epochs`: decimal years. `names`, `scale`, `n_draws`: see `statistics`. `at_once`: number of
        epochs in memory at the same time. Returns for each epoch an array (n_draws,) for each name.
        """
        statistics: list[dict[str, Float]] = []
        for k in range(0, len(epochs), at_once):
            uncached = replace(self, _cache={})  # errors at many epochs would need much memory
            statistics += uncached._together(domain, epochs[k : k + at_once], names, scale, n_draws)
        return tuple(statistics)

    @one_thread  # of linear algebra in each thread that it starts
    def _together(
        self,
        domain: EvaluationDomain,
        epochs: Sequence[float | None],
        names: Sequence[str],
        scale: Mapping[str, float] | None,
        n_draws: int | None,
    ) -> tuple[dict[str, Float], ...]:
        """Statistics at a few epochs, which use the same noise."""
        pairs = domain.pairs()
        if pairs is not None and pairs.shape[1] > MOST_PAIRS:
            rng = np.random.default_rng(self.seed)
            pairs = pairs[:, rng.choice(pairs.shape[1], MOST_PAIRS, replace=False)]
        errors = [self.errors(domain.positions.at(epoch), scale) for epoch in epochs]
        noisy = any(summed.noises for summed in errors)
        by_axis = [tuple(name.rpartition("_")[::2]) for name in names]
        # the largest difference is found from all positions, without the sampled pairs
        over_all = domain.relative == "pairs" and domain.separation is None
        n = n_draws or self.n_draws
        width = max(domain.size, 0 if pairs is None else pairs.shape[1])
        step = ROWS * max(1, self.block // (ROWS * width))

        def found(start: int) -> list[list[Float]]:
            rows, out = slice(start, min(start + step, n)), []
            normal = _normal(self.seed, rows, domain.size) if noisy else np.zeros(1)
            for error_of in errors:
                error = error_of(rows, normal)
                evaluated = error if pairs is None else error[:, pairs[0]] - error[:, pairs[1]]
                size = {axis: sizes(axis, evaluated) for axis, _ in by_axis}
                out.append(
                    [
                        extent(name, error)
                        if over_all and base == "max"
                        else of_sizes(base, size[axis])
                        for name, (axis, base) in zip(names, by_axis, strict=True)
                    ]
                )
            return out

        starts = range(0, n, step)
        if len(starts) == 1:  # faster than starting a thread
            blocks = [found(0)]
        else:
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                blocks = list(pool.map(found, starts))
        return tuple(
            {name: np.concatenate([b[e][k] for b in blocks]) for k, name in enumerate(names)}
            for e in range(len(errors))
        )

    def worst(self, domain: EvaluationDomain, axis: str = "") -> WorstPosition:
        """Position with the largest error, among both positions of each difference.

        `axis`: 'u' or 'v'; empty for both axes.
        """
        variance = np.zeros((domain.size, 2))
        for errors in self.at(domain.positions):
            # an offset common to all positions cancels in a difference
            if not (errors.uniform and domain.relative):
                variance += errors.total()
        total = variance.sum(axis=1) if not axis else variance[:, "uv".index(axis)]
        k = int(np.argmax(total))
        at = int(domain.chip[k]), float(domain.x[k]), float(domain.y[k])
        return WorstPosition(*at, float(np.sqrt(total[k])))

    def sizes(self, domain: EvaluationDomain) -> dict[str, float]:
        """Radial rms of each row over the positions, in the unit of the errors.

        Rows that are the same everywhere are left out if the domain is one of differences.
        """
        squares: dict[str, Float] = {}
        for errors in self.at(domain.positions):
            cancels = errors.uniform and domain.relative
            if not cancels and not any(row.kind == PRODUCT for row in errors.rows):
                squares |= errors.squares()
        return {name: float(np.sqrt(np.mean(s.sum(axis=1)))) for name, s in squares.items()}

    def errors(
        self, domain: EvaluationDomain, scale: Mapping[str, float] | None = None
    ) -> SummedErrors:
        """Sum of the errors of all terms, as a function of the draws.

        `domain`: positions, not differences. `scale`: factors by which rows are multiplied.
        """
        fields, scale = self.at(domain), scale or {}
        noises = [
            (scale.get(f.of.row.name, 1.0) * f.sigma, f.of.sizes)
            for f in fields
            if isinstance(f, NoiseField) and f.sigma is not None
        ]
        return SummedErrors(
            domain,
            tuple(f for f in fields if isinstance(f, DrawnField)),
            scale,
            # no noise needs to be drawn if all of them are zero
            tuple(noises) if any(np.any(sigma) for sigma, _ in noises) else (),
        )


@dataclass(frozen=True, eq=False)
class SummedErrors:
    """Errors at the positions of a domain, summed over all terms."""

    domain: EvaluationDomain
    drawn: tuple[DrawnField, ...]
    scale: Mapping[str, float]  # factors by which rows are multiplied
    # standard deviations (N, 2) of independent errors, and their factors; see `Independent`
    noises: tuple[tuple[Float, Mapping[int, Float]], ...]

    def __call__(self, rows: slice, normal: Float) -> Float:
        """Errors (d, N, 2) of the draws `rows`, from standard normal numbers of the same shape."""
        # each axis is contiguous in memory, as the terms evaluate their errors
        out = np.zeros((rows.stop - rows.start, 2, self.domain.size)).swapaxes(1, 2)
        if self.noises:
            out += normal * np.sqrt(self._variance(rows))
        for field_errors in self.drawn:
            out += field_errors.errors(rows, self.scale)
        return out

    def _variance(self, rows: slice) -> Float:
        """Variance (N, 2) of all independent errors, or (d, N, 2) if it differs between draws."""
        variance = np.zeros((self.domain.size, 2))
        for sigma, _ in self.noises:
            variance = variance + sigma**2
        if not any(size for _, size in self.noises):
            return variance
        drawn = np.tile(variance, (rows.stop - rows.start, 1, 1))
        for sigma, size in self.noises:
            for chip, rows_of_chip in self.domain.by_chip():
                if chip in size:
                    drawn[:, rows_of_chip] += (size[chip][rows, None] - 1.0) * sigma[
                        rows_of_chip
                    ] ** 2
        return np.maximum(drawn, 0.0)


def _normal(seed: int, rows: slice, n_positions: int) -> Float:
    """Standard normal numbers (rows, N, 2); a draw has the same ones in any block."""
    shape = ROWS, n_positions, 2
    starts = range(rows.start, rows.stop, ROWS)
    out = np.empty((len(starts), *shape))
    for block, k in zip(out, starts, strict=True):
        np.random.default_rng((seed, k)).standard_normal(out=block)
    return out.reshape(-1, n_positions, 2)[: rows.stop - rows.start]
