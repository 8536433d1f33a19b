"""All errors of a position, drawn once, and statistics of them over parts of the detector.

What is drawn serves every requirement, epoch and part of the detector, and every question of the
kind "what if this term were half as large": so differences between answers are not differences of
draws.
"""

from __future__ import annotations

import os
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from bayesdist.assess.domain import EvaluationDomain, WorstPosition
from bayesdist.assess.statistics import extent, of_sizes, sizes
from bayesdist.assess.terms.forms import (
    PRODUCT,
    DrawnField,
    ErrorDraws,
    ErrorField,
    ErrorTerm,
    Image,
    NoiseField,
    Pool,
)
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.solution.solution import Solution
from bayesdist.utils.arrays import Float

ROWS = 16  # draws whose noise comes from one generator: so that blocks do not change it
BLOCK = 60_000  # positions times draws whose errors a thread holds at once: in its cache
EPOCHS = 8  # whose polynomials are in memory at once
MOST_PAIRS = 5000  # pairs of positions that stand for all: percentiles over them to about 1 %


def generators(terms: Sequence[ErrorTerm], seed: int) -> list[np.random.Generator]:
    """A generator for each term, by the name of its first row and how often that came before.

    The draws of a term do not depend on what other terms there are.
    """
    seen: Counter[str] = Counter()
    out = []
    for term in terms:
        name = term.rows[0].name
        out.append(np.random.default_rng([seed, zlib.crc32(name.encode()), seen[name]]))
        seen[name] += 1
    return out


@dataclass(frozen=True, eq=False)
class DrawnErrors:
    """Draws of everything that moves a position."""

    solution: Solution
    terms: tuple[ErrorTerm, ...]
    draws: tuple[ErrorDraws, ...]  # one for each term
    image: Image
    n_draws: int
    seed: int  # of the errors that are independent from position to position, and of the terms
    # makes so many further draws of the same errors, another set for each number from 1 on
    further: Callable[[int, int], DrawnErrors] | None = None
    _cache: dict[EvaluationDomain, tuple[ErrorField, ...]] = field(default_factory=dict, repr=False)

    @property
    def unit(self) -> str:
        """Unit of all errors."""
        return self.solution.model.unit

    @property
    def n_effective(self) -> float:
        """Independent draws that are worth at least as much as these; at least 1.

        Taking n draws from a finite set worth m independent ones, as a chain is, adds the set's own
        Monte-Carlo variance to that of the drawing.  The shares of several sets in the variance of
        a probability add up to 1 at most: 1 / n_eff = 1 / n + 1 / m at most, for the smallest m.
        """
        least = min((pool.size for pool in self.pools), default=np.inf)
        return max(1.0 / (1.0 / self.n_draws + 1.0 / least), 1.0)

    @property
    def pools(self) -> tuple[Pool, ...]:
        """Finite sets that draws of the terms are taken from."""
        return tuple(pool for one in self.draws for pool in one.pools)

    def at(self, domain: EvaluationDomain) -> tuple[ErrorField, ...]:
        """The errors of each term at the positions of a domain."""
        if domain not in self._cache:
            self._cache[domain] = tuple(one.on(domain, self.image) for one in self.draws)
        return self._cache[domain]

    def treatments(self, grid: tuple[int, int] | None) -> tuple[DrawnErrors, ...]:
        """Draws with what may vary over the field varying: smoothly, and everywhere.

        Nothing where no term may vary.

        `grid`: points of each chip over which a smooth field has its size.
        """
        model = self.solution.model
        others = [
            getattr(term, "treatments", lambda *_: ())(model, grid) or (term, term)
            for term in self.terms
        ]
        if all(pair == (term, term) for pair, term in zip(others, self.terms, strict=True)):
            return ()
        out = []
        for way in zip(*others, strict=True):
            random = generators(way, self.seed)
            draws = tuple(
                old if new is term else new.draw(self.n_draws, rng)
                for old, term, new, rng in zip(self.draws, self.terms, way, random, strict=True)
            )
            out.append(replace(self, terms=way, draws=draws, further=None, _cache={}))
        return tuple(out)

    def statistics(
        self,
        domain: EvaluationDomain,
        names: Sequence[str],
        *,
        scale: Mapping[str, float] | None = None,
        n_draws: int | None = None,
    ) -> dict[str, Float]:
        """Statistics of each draw's error over the positions, or over pairs of them.

        `names`: of `STATISTICS`. `scale`: factors by which rows are multiplied. `n_draws`: the
        first so many of the draws; all by default. Returns (n_draws,). InputError for no pair of
        positions that near, a magnitude where no errors by magnitude are known, and a missing
        epoch.
        """
        (found,) = self._together(domain, (domain.epoch,), names, scale, n_draws)
        return found

    def over_epochs(
        self,
        domain: EvaluationDomain,
        epochs: Sequence[float | None],
        names: Sequence[str],
        *,
        scale: Mapping[str, float] | None = None,
        n_draws: int | None = None,
    ) -> tuple[dict[str, Float], ...]:
        """Statistics at several epochs, sooner than one by one.

        `epochs`: decimal years. `names`, `scale`, `n_draws`: as `statistics`. Returns (n_draws,),
        one for each epoch.
        """
        found: list[dict[str, Float]] = []
        for k in range(0, len(epochs), EPOCHS):
            some = replace(self, _cache={})  # errors at so many epochs are not kept
            found += some._together(domain, epochs[k : k + EPOCHS], names, scale, n_draws)
        return tuple(found)

    @one_thread  # of each thread that it starts
    def _together(
        self,
        domain: EvaluationDomain,
        epochs: Sequence[float | None],
        names: Sequence[str],
        scale: Mapping[str, float] | None,
        n_draws: int | None,
    ) -> tuple[dict[str, Float], ...]:
        """Statistics at a few epochs, for all of which the noise is drawn once."""
        pairs = domain.pairs()
        if pairs is not None and pairs.shape[1] > MOST_PAIRS:
            rng = np.random.default_rng(self.seed)
            pairs = pairs[:, rng.choice(pairs.shape[1], MOST_PAIRS, replace=False)]
        errors = [self.errors(domain.positions.at(epoch), scale) for epoch in epochs]
        noisy = any(one.noises for one in errors)
        by_axis = [tuple(name.rpartition("_")[::2]) for name in names]
        # largest differences are those of all positions, not of pairs that stand for them
        over_all = domain.relative == "pairs" and domain.separation is None
        n = n_draws or self.n_draws
        width = max(domain.size, 0 if pairs is None else pairs.shape[1])
        step = ROWS * max(1, BLOCK // (ROWS * width))

        def found(start: int) -> list[list[Float]]:
            rows, out = slice(start, min(start + step, n)), []
            normal = _normal(self.seed, rows, domain.size) if noisy else np.zeros(1)
            for error_of in errors:
                error = error_of(rows, normal)
                seen = error if pairs is None else error[:, pairs[0]] - error[:, pairs[1]]
                size = {axis: sizes(axis, seen) for axis, _ in by_axis}
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
        if len(starts) == 1:  # sooner than a thread starts
            blocks = [found(0)]
        else:
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                blocks = list(pool.map(found, starts))
        return tuple(
            {name: np.concatenate([b[e][k] for b in blocks]) for k, name in enumerate(names)}
            for e in range(len(errors))
        )

    def worst(self, domain: EvaluationDomain, axis: str = "") -> WorstPosition:
        """The position at which the error is largest; of two, the one farther off.

        `axis`: one of '', 'u', 'v', of which axis; of both by default.
        """
        variance = np.zeros((domain.size, 2))
        for one in self.at(domain.positions):
            # what all positions share is no error of a difference
            if not (one.uniform and domain.relative):
                variance += one.total()
        total = variance.sum(axis=1) if not axis else variance[:, "uv".index(axis)]
        k = int(np.argmax(total))
        at = int(domain.chip[k]), float(domain.x[k]), float(domain.y[k])
        return WorstPosition(*at, float(np.sqrt(total[k])))

    def sizes(self, domain: EvaluationDomain) -> dict[str, float]:
        """Radial root mean square of each row over the positions."""
        squares: dict[str, Float] = {}
        for one in self.at(domain.positions):
            if not any(row.kind == PRODUCT for row in one.rows):
                squares |= one.squares()
        return {name: float(np.sqrt(np.mean(s.sum(axis=1)))) for name, s in squares.items()}

    def errors(
        self, domain: EvaluationDomain, scale: Mapping[str, float] | None = None
    ) -> SummedErrors:
        """Errors of all terms, by draws.

        `domain`: of positions, not of differences. `scale`: factors by which rows are multiplied.
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
            # nothing is drawn where all of them are zero
            tuple(noises) if any(np.any(sigma) for sigma, _ in noises) else (),
        )


@dataclass(frozen=True, eq=False)
class SummedErrors:
    """Errors at the positions of a domain, summed over all terms."""

    domain: EvaluationDomain
    drawn: tuple[DrawnField, ...]
    scale: Mapping[str, float]  # factors by which rows are multiplied
    # standard deviations (N, 2) of independent errors, and sizes as of `Independent`
    noises: tuple[tuple[Float, Mapping[int, Float]], ...]

    def __call__(self, rows: slice, normal: Float) -> Float:
        """Errors (d, N, 2) of some draws, given as many normal numbers for the noise."""
        # in memory axis by axis, as the terms evaluate their errors
        out = np.zeros((rows.stop - rows.start, 2, self.domain.size)).swapaxes(1, 2)
        if self.noises:
            out += normal * np.sqrt(self._variance(rows))
        for one in self.drawn:
            out += one.errors(rows, self.scale)
        return out

    def _variance(self, rows: slice) -> Float:
        """Variance (N, 2) of all independent errors, or (d, N, 2) where it differs by draw."""
        variance = np.zeros((self.domain.size, 2))
        for sigma, _ in self.noises:
            variance = variance + sigma**2
        if not any(size for _, size in self.noises):
            return variance
        drawn = np.tile(variance, (rows.stop - rows.start, 1, 1))
        for sigma, size in self.noises:
            for chip, here in self.domain.by_chip():
                if chip in size:
                    drawn[:, here] += (size[chip][rows, None] - 1.0) * sigma[here] ** 2
        return np.maximum(drawn, 0.0)


def _normal(seed: int, rows: slice, n_positions: int) -> Float:
    """Standard normal numbers (rows, N, 2), those of a draw the same in any block."""
    shape = ROWS, n_positions, 2
    starts = range(rows.start, rows.stop, ROWS)
    out = np.empty((len(starts), *shape))
    for block, k in zip(out, starts, strict=True):
        np.random.default_rng((seed, k)).standard_normal(out=block)
    return out.reshape(-1, n_positions, 2)[: rows.stop - rows.start]
