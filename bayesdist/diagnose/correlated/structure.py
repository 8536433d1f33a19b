"""Posterior of the structure that a polynomial lacks, with its amplitudes marginalised.

With the part that the fit absorbs eliminated, the data determine the coefficients z of the
structure's functions through a score s and an information matrix S.  For amplitudes eta,

    z | eta   ~ N((S + P)^-1 s, (S + P)^-1)             P = P(eta), the prior precision
    log p(eta | data) = log p(eta) + (s^T (S + P)^-1 s - log|S + P| + log|P|) / 2

The amplitude and the correlation length of the Matern field and the amplitude of the higher orders
are integrated over a grid that is refined where the density is large.  Structure too fine for the
functions appears in neighbouring stars (`SharedVariance`).  Their likelihood is a factor: that of
the part of the field finer than the functions, with the resolved part subtracted from the scores.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import TypeVar

import numpy as np

from bayesdist.diagnose.correlated.neighbours import SharedVariance
from bayesdist.diagnose.correlated.priors import (
    FINE,
    SHORTEST,
    STRUCTURE_DOF,
    AmplitudeGrid,
    StructureFunctions,
    log_half_t,
    log_widths,
)
from bayesdist.utils.arrays import Float, Int

Shared = TypeVar("Shared")
Evidence = Sequence[SharedVariance | None]

# of the field, in longer half sides; equal prior probabilities
LENGTHS = np.geomspace(SHORTEST, 0.6, 7)
STEPS = 8  # in amplitude, before the grid is refined
# limit to the refinements: neighbouring stars may determine an amplitude to a few per cent
HALVINGS = 6
CHANGE = 0.7  # largest change of the log density between two points without a point between them,
WIDEST = 0.4  # and largest interval in log(amplitude), where most of the density is
NEGLIGIBLE = 10.0  # difference in log density from the maximum
NEAR_TOP = 2.0  # likewise, for the region with most of the density
UNLIKE = 0.2  # prior probability that the amplitude differs between both axes, by about a factor e


@dataclass(frozen=True, eq=False)
class FieldLikelihood:
    """Likelihood of a field with one correlation length, on one or more axes, for any amplitude.

    The coefficients of the sines are scaled to the variance that they have in a field of unit
    variance, and expressed in the eigenvectors of their information.  These serve for every
    amplitude.
    """

    root: Float  # (n_sines,) standard deviations of the coefficients in a field of unit variance
    values: Float  # (n_sines,) eigenvalues of the sines' information
    vectors: Float  # (n_sines, n_sines) its eigenvectors
    score: Float  # (n_sines,) score of the sines along these
    tied: Float  # (n_sines, T) information between the sines, along these, and the terms
    terms: Float  # (T, T) information of the terms
    terms_score: Float

    @classmethod
    def of(
        cls, blocks: Sequence[StructureFunctions], length: float, S: Float, s: Float
    ) -> FieldLikelihood:
        """Build from information and score of all terms of all blocks, followed by their sines."""
        scale = np.concatenate([block.decline() for block in blocks])
        root = np.sqrt(np.concatenate([block.spectrum(length) for block in blocks]))
        T = len(scale)
        values, vectors = np.linalg.eigh(S[T:, T:] * np.outer(root, root))
        along = vectors.T * root
        return cls(
            root,
            np.maximum(values, 0.0),
            vectors,
            along @ s[T:],
            along @ S[T:, :T] * scale,
            S[:T, :T] * np.outer(scale, scale),
            s[:T] * scale,
        )

    def at(self, amplitude: float) -> SizedField:
        """Likelihood for the given amplitude."""
        variance = 1 / (self.values + amplitude**-2)
        weighted = self.tied.T * variance
        values, vectors = np.linalg.eigh(self.terms - weighted @ self.tied)
        along = vectors.T @ (self.terms_score - weighted @ self.score)
        return SizedField(self, amplitude, variance, np.maximum(values, 0.0), vectors, along)

    def draws(self, terms: Float, variance: Float, rng: np.random.Generator) -> Float:
        """Draw sines (m, n_sines) for given terms (m, T) and variances (m, n_sines)."""
        along = variance * (self.score - terms @ self.tied.T)
        along += np.sqrt(variance) * (rng.standard_normal(variance.shape) @ self.vectors)
        return np.asarray((along @ self.vectors.T) * self.root)


@dataclass(frozen=True, eq=False)
class SizedField:
    """Likelihood of the terms, given the correlation length and amplitude of the field."""

    field: FieldLikelihood
    amplitude: float
    variance: Float  # (n_sines,) of the sines along their eigenvectors, given the terms
    values: Float  # (T,) eigenvalues of the terms' information with the sines marginalised
    vectors: Float  # (T, T) its eigenvectors
    score: Float  # (T,) score of the terms along these

    def log_evidence(self, amplitudes: Float) -> Float:
        """Log evidence as a function of the amplitudes of the terms."""
        out = 0.5 * self.variance @ self.field.score**2
        out -= 0.5 * np.log1p(self.field.values * self.amplitude**2).sum()
        out += 0.5 * (self.score**2 / (self.values + amplitudes[:, None] ** -2)).sum(axis=1)
        return np.asarray(out - 0.5 * np.log1p(self.values * amplitudes[:, None] ** 2).sum(axis=1))

    def draws(self, amplitude: Float, rng: np.random.Generator) -> Float:
        """Draw terms (m, T), given their amplitudes (m,)."""
        precision = self.values + amplitude[:, None] ** -2
        # multiply noise by symmetric roots, which do not depend on signs and order of eigenvectors
        noise = rng.standard_normal((len(precision), len(self.values))) @ self.vectors
        return np.asarray((self.score / precision + noise / np.sqrt(precision)) @ self.vectors.T)


@dataclass(frozen=True, eq=False)
class _Point:
    """A correlation length, and the amplitude of the field in each part."""

    length: float
    amplitudes: tuple[float, ...]
    parts: tuple[SizedField, ...]


@dataclass(frozen=True, eq=False)
class Structure:
    """Posterior of the structure."""

    # functions of each part: of one axis of a chip, or of all axes of all chips if these are
    # coupled
    functions: tuple[tuple[StructureFunctions, ...], ...]
    terms_amplitude: Float  # (TERM_STEPS,) grid of amplitudes of the higher orders
    points: tuple[_Point, ...]  # grid of correlation lengths and amplitudes of the field
    weight: Float  # (points, TERM_STEPS) posterior probability of each combination

    def draws(
        self, n: int, rng: np.random.Generator, waves: Sequence[Sequence[Float]] | None = None
    ) -> list[Float]:
        """Draw coefficients (n, n_known + 2 FINE) of terms, sines and finer waves of each function.

        `waves` contains the wave vectors (FINE, 2) of each function of each part; finer waves are
        left out if it is None.
        """
        counts = rng.multinomial(n, self.weight.ravel())
        drawn = rng.permutation(np.repeat(np.arange(len(counts)), counts))
        point, by_terms = np.divmod(drawn, self.weight.shape[1])
        amplitude = self.terms_amplitude[by_terms]
        out = []
        for k, part_functions in enumerate(self.functions):
            terms, sines = self._known(k, point, amplitude, rng)
            finer = rng.standard_normal((len(part_functions), n, 2 * FINE if waves else 0))
            if waves:
                spread = self._finer(k, waves[k])[:, point]
                finer *= np.concatenate([spread, spread], axis=2)  # cosines and sines
            first, start = 0, 0
            for functions, wave in zip(part_functions, finer, strict=True):
                of_terms = terms[:, first : first + functions.n_terms] * functions.decline()
                along = sines[:, start : start + functions.n_sines]
                out.append(np.concatenate([of_terms, along, wave], axis=1))
                first, start = first + functions.n_terms, start + functions.n_sines
        return out

    def _known(
        self, part: int, point: Int, amplitude: Float, rng: np.random.Generator
    ) -> tuple[Float, Float]:
        """Draw terms (n, T) and sines (n, n_sines) of a part at points (n,).

        `amplitude` (n,) are the amplitudes of the terms.
        """
        sized = [p.parts[part] for p in self.points]  # many points have the same one
        terms = np.empty((len(point), len(sized[0].values)))
        variance = np.empty((len(point), len(sized[0].variance)))
        for field_at_size, rows in _rows_of(sized, point):
            terms[rows] = field_at_size.draws(amplitude[rows], rng)
            variance[rows] = field_at_size.variance
        sines = np.empty_like(variance)
        for of_length, rows in _rows_of([field_at_size.field for field_at_size in sized], point):
            sines[rows] = of_length.draws(terms[rows], variance[rows], rng)
        return terms, sines

    def _finer(self, part: int, waves: Sequence[Float]) -> Float:
        """Standard deviations (functions, points, FINE) of the waves finer than a part's sines."""
        size, length = np.array([(p.amplitudes[part], p.length) for p in self.points]).T
        lengths, of_point = np.unique(length, return_inverse=True)
        functions = zip(self.functions[part], waves, strict=True)
        variance = np.array([[f.finer_spectrum(l, w) for l in lengths] for f, w in functions])
        return np.asarray(size[:, None] * np.sqrt(variance)[:, of_point])

    @property
    def length(self) -> float:
        """Posterior mean correlation length of the field, weighted by variance, in half sides."""
        by_point = self.weight.sum(axis=1)
        by_point = by_point * [np.square(p.amplitudes).sum() for p in self.points]
        return float(by_point @ [p.length for p in self.points] / by_point.sum())


def _rows_of(of_point: Sequence[Shared], point: Int) -> Iterator[tuple[Shared, Int]]:
    """Iterate over the distinct items of the points, with indices of the draws that have them."""
    number = {item: k for k, item in enumerate(dict.fromkeys(of_point))}
    drawn = np.array([number[item] for item in of_point])[point]
    for item, k in number.items():
        yield item, np.flatnonzero(drawn == k)


def structure_posterior(
    functions: Sequence[Sequence[StructureFunctions]],
    information: Sequence[Float],
    score: Sequence[Float],
    *,
    noise: float,
    higher_order: float,
    structure: float,
    pairs: Evidence | Callable[[Structure], Evidence] = (None, None),
    lengths: Float | None = None,
) -> Structure:
    """Posterior of the coefficients of structure functions, for one part or two.

    For matched stars the parts are the two axes of a chip.  Correlation length and amplitudes are
    common to both axes: light or silicon bends along both, and few data hardly determine each axis
    alone.  The amplitudes may differ, however, as for a pattern of columns.  Fitted stars couple
    all axes of all chips, which are then a single part.

    For the `functions` of each part, `information` (m, m) is that of their coefficients, and
    `score` (m,) is the gradient of the log-likelihood where they are zero, both with the part that
    the fit absorbs eliminated.  `pairs` is the evidence of neighbouring stars on each part, or a
    function that computes it from a posterior without that evidence.  `noise` is the typical error
    of one star, which limits the amplitudes; `higher_order` and `structure` are prior medians of
    the amplitudes, in the unit of the positions.  `lengths` are the correlation lengths of the
    field, by default `LENGTHS`.
    """
    parts = [_terms_first(*part) for part in zip(functions, information, score, strict=True)]
    amplitudes = AmplitudeGrid.of(
        max(
            (
                np.diag(S)[: sum(f.n_terms for f in part_functions)]
                for part_functions, S, _ in parts
            ),
            key=np.median,
        ),
        noise=noise,
        higher_order=higher_order,
        structure=structure,
    )
    by_amplitude = {
        float(length): _SizedFields(
            [
                FieldLikelihood.of(part_functions, float(length), S, s)
                for part_functions, S, s in parts
            ],
            amplitudes.terms,
        )
        for length in (LENGTHS if lengths is None else lengths)
    }
    cuts = [part_functions[0].cut for part_functions in functions]
    if callable(pairs):
        pairs = pairs(_weighed(functions, by_amplitude, amplitudes, structure, (), cuts))
    return _weighed(functions, by_amplitude, amplitudes, structure, pairs, cuts)


def _weighed(
    functions: Sequence[Sequence[StructureFunctions]],
    by_amplitude: Mapping[float, _SizedFields],
    amplitudes: AmplitudeGrid,
    structure: float,
    pairs: Evidence,
    cuts: Sequence[float],
) -> Structure:
    """Posterior over correlation lengths and amplitudes, with the evidence of neighbouring stars.

    `cuts` are the frequencies of each part above which that evidence applies.
    """
    by_length = list[tuple[float, list[_Sized], Float]]()
    for length, fields in by_amplitude.items():
        shared = [
            None if p is None else p.of_field(length, cut)
            for p, cut in zip(pairs, cuts, strict=False)
        ]
        sized = _refined(partial(_Sized.of, fields, shared), amplitudes, structure)
        by_length.append((length, sized, amplitudes.log_prior + _density(sized, structure)))
    largest = max(density.max() for _, _, density in by_length)
    points, log_weight = list[_Point](), list[Float]()
    for length, sized, density in by_length:
        for at in np.argwhere(density.max(axis=-1) > largest - NEGLIGIBLE):
            chosen = [sized[k] for k in at]
            sizes = tuple(sized_field.amplitude for sized_field in chosen)
            parts = tuple(sized_field.parts[k] for k, sized_field in enumerate(chosen))
            points.append(_Point(length, sizes, parts))
            log_weight.append(density[tuple(at)] - largest)
    weight = np.exp(log_weight)
    return Structure(
        tuple(tuple(part_functions) for part_functions in functions),
        amplitudes.terms,
        tuple(points),
        weight / weight.sum(),
    )


def _terms_first(
    functions: Sequence[StructureFunctions], S: Float, s: Float
) -> tuple[Sequence[StructureFunctions], Float, Float]:
    """Functions, with the information and score of all terms followed by those of all sines."""
    is_sine = np.concatenate(
        [
            np.arange(chip_functions.n_known) >= chip_functions.n_terms
            for chip_functions in functions
        ]
    )
    order = np.argsort(is_sine, kind="stable")
    return functions, S[np.ix_(order, order)], s[order]


@dataclass(frozen=True, eq=False)
class _SizedFields:
    """Fields of one correlation length in all parts, computed once per amplitude."""

    fields: Sequence[FieldLikelihood]
    of_terms: Float  # (TERM_STEPS,) amplitudes of the terms
    _cache: dict[float, tuple[tuple[SizedField, ...], Float]] = field(default_factory=dict)

    def at(self, log_amplitude: float) -> tuple[tuple[SizedField, ...], Float]:
        """Likelihoods of the terms, and their evidence (parts, TERM_STEPS)."""
        if log_amplitude not in self._cache:
            parts = tuple(f.at(float(np.exp(log_amplitude))) for f in self.fields)
            evidence = np.stack([part.log_evidence(self.of_terms) for part in parts])
            self._cache[log_amplitude] = parts, evidence
        return self._cache[log_amplitude]


@dataclass(frozen=True, eq=False)
class _Sized:
    """One amplitude of the field, and the evidence (parts, TERM_STEPS) of each part for it."""

    amplitude: float
    parts: tuple[SizedField, ...]
    evidence: Float

    @classmethod
    def of(
        cls,
        fields: _SizedFields,
        shared: Sequence[Callable[[float], float] | None],
        log_amplitude: float,
    ) -> _Sized:
        """Build from the fields of all parts, and the evidence of neighbouring stars."""
        amplitude = float(np.exp(log_amplitude))
        parts, evidence = fields.at(float(log_amplitude))
        near = np.zeros(len(parts))
        for k, likelihood in enumerate(shared):
            near[k] = 0.0 if likelihood is None else likelihood(amplitude)
        return cls(amplitude, parts, evidence + near[:, None])

    @property
    def views(self) -> Float:
        """Evidence (1 + parts, TERM_STEPS) of all parts together, and of each part."""
        return np.stack([self.evidence.sum(axis=0), *self.evidence])


def _refined(
    at: Callable[[float], _Sized], amplitudes: AmplitudeGrid, median: float
) -> list[_Sized]:
    """Ascending amplitudes of the field, spaced more closely where the density changes."""
    prior = amplitudes.log_prior
    grid = list(np.linspace(np.log(amplitudes.low), np.log(amplitudes.high), STEPS))
    sized = [at(a) for a in grid]
    for _ in range(HALVINGS):
        tops = np.array([(prior + sized_field.views).max(axis=1) for sized_field in sized])
        tops += log_half_t(np.exp(grid), median, STRUCTURE_DOF)[:, None]
        # maximum for this correlation length: a peak may be between two points
        best = tops.max(axis=0)
        # refine separately for each part only if the parts may differ
        several = len(best) - 1
        apart = best[1:].sum() > best[0] + (several - 1) * prior.max() + CHANGE
        middles = set[float]()
        for k in range(1 + several if apart else 1):
            middles.update(_middles(grid, tops[:, k].tolist(), float(best[k])))
        if not middles:
            break
        sized += [at(a) for a in middles]
        grid += middles
        order = np.argsort(grid)
        grid, sized = [grid[k] for k in order], [sized[k] for k in order]
    return sized


def _density(sized: Sequence[_Sized], median: float) -> Float:
    """Log density of the amplitudes of the field in each part, and of the terms.

    The shape is (n, TERM_STEPS) for one part and (n, n, TERM_STEPS) for two.
    """
    amplitude = np.array([sized_field.amplitude for sized_field in sized])
    width = log_widths(amplitude, beyond=0.0)
    evidence = np.stack([sized_field.evidence for sized_field in sized], axis=1)
    if len(evidence) == 1:
        return np.asarray(
            (log_half_t(amplitude, median, STRUCTURE_DOF) + width)[:, None] + evidence[0]
        )
    u, v = evidence
    mean_square = np.add.outer(amplitude**2, amplitude**2) / 2
    apart = np.abs(np.subtract.outer(np.log(amplitude), np.log(amplitude)))
    differ = np.log(UNLIKE / 2) - apart + width
    np.fill_diagonal(differ, np.log(1 - UNLIKE))
    density = log_half_t(np.sqrt(mean_square), median, STRUCTURE_DOF) + width[:, None] + differ
    return np.asarray(density[..., None] + u[:, None] + v)


def _middles(grid: Sequence[float], tops: Sequence[float], best: float) -> list[float]:
    """Midpoints of the intervals where the density is not negligible and changes strongly."""
    out = []
    for (a, top_a), (b, top_b) in pairwise(zip(grid, tops, strict=True)):
        top = max(top_a, top_b)
        changes = top > best - NEGLIGIBLE and abs(top_a - top_b) > CHANGE
        # a peak may be between two points of equal height
        if changes or (top > best - NEAR_TOP and b - a > WIDEST):
            out.append(0.5 * (a + b))
    return out
