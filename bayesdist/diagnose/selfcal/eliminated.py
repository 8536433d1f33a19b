"""Information and scores of parameters and of further functions, with the stars eliminated.

A detection is displaced by the parameters, by functions over its chip and by deviations of its
exposure; its star follows.  With Z the derivatives of positions by all of these, S those by a
star's own parameters, H the curvature and g the gradient of each detection,

    N = sum Z^T H Z - sum_s T^T A^-1 T        T = sum S^T H Z,  A = sum S^T H S + prior
    score = sum Z^T g - sum_s T^T A^-1 b      b = sum S^T g - pull of the prior

where the second sums go over the stars, and those within over the detections of each.  Polynomials
and functions over a chip are dense columns, parameters of single exposures sparse ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from bayesdist.diagnose.clusters import sums_over
from bayesdist.diagnose.correlated.deviations import DeviationColumns, deviation_columns
from bayesdist.diagnose.correlated.functions import StructureFunctions
from bayesdist.diagnose.efficient import EfficientScore
from bayesdist.diagnose.selfcal.scores import (
    UNKNOWN,
    DetectionScores,
    inverse_roots,
    places_by_star,
)
from bayesdist.infer.equations.scaled import determined
from bayesdist.infer.selfcal.elimination import PlaceDerivatives
from bayesdist.infer.selfcal.mode import SelfCalibrationMode
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.utils.arrays import Bool, Float, Int

DETECTIONS = 8192  # in memory at a time
MAX_DETECTIONS = 60_000  # that are looked at
MAX_EXPOSURES = 150  # whose single deviations are looked at


@dataclass(frozen=True, eq=False)
class Columns:
    """Displacements of detections by parameters, functions over chips and deviations of exposures.

    In this order they are the columns of all matrices; functions of one chip after the other, those
    along u before those along v.  `functions` are by the code of a chip; none by default.
    """

    problem: Problem
    theta: Float
    functions: Mapping[int, StructureFunctions] = field(default_factory=dict)
    deviations: DeviationColumns | None = None

    @cached_property
    def structure(self) -> PlaceDerivatives:
        """Dependence of positions on the parameters."""
        return PlaceDerivatives.at(self.problem, self.theta)

    @property
    def n_params(self) -> int:
        """Number of parameters."""
        return self.problem.model.n_params

    def n_functions(self, chip: int) -> int:
        """Number of functions over a chip (by code), along one axis."""
        return self.functions[chip].n_known if chip in self.functions else 0

    def values(self, chip: int, rows: Int) -> Float:
        """Values (n, n_functions) of the functions at some detections on the chip."""
        if chip not in self.functions:
            return np.zeros((len(rows), 0))
        return self.functions[chip].evaluate(self.problem.X[rows], self.problem.Y[rows])

    @cached_property
    def widths(self) -> tuple[int, ...]:
        """Number of dense columns of each chip along one axis."""
        K, chips = self.problem.model.n_terms, range(len(self.problem.model.chips))
        return tuple(K + self.n_functions(c) for c in chips)

    @cached_property
    def n_sparse(self) -> int:
        """Number of parameters that are no polynomials, and of deviations."""
        others = self.n_params - self.problem.model.n_polynomial
        return others + (0 if self.deviations is None else len(self.deviations))

    def dense(self, chip: int, axis: int) -> slice:
        """Internal slice of the dense columns of a chip and axis: polynomials, then functions."""
        first = 2 * sum(self.widths[:chip]) + axis * self.widths[chip]
        return slice(first, first + self.widths[chip])

    @property
    def sparse(self) -> slice:
        """Internal slice of the sparse columns."""
        first = 2 * sum(self.widths)
        return slice(first, first + self.n_sparse)

    @cached_property
    def order(self) -> Int:
        """Internal index of each column."""
        K, chips = self.problem.model.n_terms, range(len(self.widths))
        inside = [np.arange(self.sparse.stop)[self.dense(c, a)] for c in chips for a in (0, 1)]
        others = np.arange(self.sparse.start, self.sparse.stop)
        n = self.n_params - self.problem.model.n_polynomial
        parts = [*(one[:K] for one in inside), others[:n], *(one[K:] for one in inside)]
        return np.concatenate([*parts, others[n:]])

    @cached_property
    def centre(self) -> Float:
        """Mean position of the exposures along the axes of the polynomials; 0 if none deviate."""
        if self.deviations is None:
            return np.zeros(2)
        p, out = self.problem, []
        phi = np.zeros((1, p.model.n_terms))
        phi[0, 0] = 1.0
        for chip, epoch in zip(p.groups.chip, p.groups.epoch, strict=True):
            out.append(self.deviations.positions(int(chip), float(epoch), phi)[0])
        return np.mean(out, axis=0)


@dataclass(frozen=True, eq=False)
class EvenStars:
    """Some stars of a solution, or all; a part of them is less informative, and unbiased."""

    rows: Bool  # (N,) of their detections, among those of all stars
    problem: Problem
    stars: Float  # (S, q)
    deviations: DeviationColumns | None  # of their exposures

    @classmethod
    def of(cls, solution: SelfCalibrationMode) -> EvenStars:
        """All stars, or every k-th, so that there are no more detections than `MAX_DETECTIONS`."""
        whole = solution.problem
        some = np.arange(0, whole.n_stars, int(np.ceil(len(whole) / MAX_DETECTIONS)))
        problem = whole.of_stars(some)
        groups = problem.groups
        counts = np.bincount(groups.index, minlength=len(groups)).astype(float)
        deviations = deviation_columns(
            whole.model, solution.theta, groups, counts, most=MAX_EXPOSURES
        )
        return cls(np.isin(whole.star, some), problem, solution.stars[some], deviations)


@dataclass(frozen=True, eq=False)
class Piece:
    """Some stars with their n detections, displaced along the axes of the polynomials."""

    stars: slice  # in the problem
    rows: slice  # of the detections, in the problem
    star: Int  # which of these stars each detection (n,) belongs to
    by_star: Float  # derivatives (n, 2, q) of positions by the parameters of their stars
    frame: Float  # matrix (n, 2, 2) from the axes of the polynomials to those of the sky
    # for each chip, the detections on it, and the values of its columns
    dense: tuple[tuple[Int, Float], ...]
    sparse: csr_array  # displacements along both axes, in turn (2 n, n_sparse)

    def scores(self, every: DetectionScores) -> DetectionScores:
        """Scores of these detections along the axes of the polynomials."""
        some = every.at(self.rows)
        gradient = np.einsum("nab,na->nb", self.frame, some.gradient)
        return DetectionScores(gradient, self.frame.mT @ some.curvature @ self.frame)

    def __len__(self) -> int:
        return len(self.star)

    def of_stars(self, values: Float) -> csr_array:
        """Matrix (S q, n k) that sums values (n, q, k) of the detections over their stars."""
        n, q, k = values.shape
        row = np.repeat(self.star[:, None] * q + np.arange(q), k)
        column = np.repeat(np.arange(n)[:, None] * k, q, axis=1)[..., None] + np.arange(k)
        shape = (q * (self.stars.stop - self.stars.start), n * k)
        return csr_array((values.ravel(), (row, column.ravel())), shape=shape)


def pieces(columns: Columns) -> Iterator[Piece]:
    """Iterator over the detections in chunks of some stars."""
    p, structure = columns.problem, columns.structure
    n_sparse_params = columns.n_params - p.model.n_polynomial
    bases = [p.model.basis(chip.number) for chip in p.model.chips]
    first = 0
    while first < p.n_stars:
        last = int(np.searchsorted(p.starts, p.starts[first] + DETECTIONS, side="right")) - 1
        last = min(max(last, first + 1), p.n_stars)
        rows = slice(int(p.starts[first]), int(p.starts[last]))
        group = p.groups.index[rows]
        chip, n = p.groups.chip[group], rows.stop - rows.start
        phi = np.empty((n, p.model.n_terms))
        dense = []
        for code, basis in enumerate(bases):
            here = np.flatnonzero(chip == code)
            phi[here] = basis.evaluate_scaled(p.X[rows][here], p.Y[rows][here])
            more = columns.values(code, rows.start + here)
            dense.append((here, np.concatenate([phi[here], more], axis=1)))
        entries = []
        back = np.linalg.inv(structure.linear)
        for g in np.unique(group):
            here = np.flatnonzero(group == g)
            # parameters of exposures and drifts
            used = np.flatnonzero(structure.columns[g] >= 0)
            values = np.einsum("mak,nk->nam", back[g] @ structure.extra[g][used], phi[here])
            moved = [(structure.columns[g][used] - p.model.n_polynomial, values)]
            if columns.deviations is not None:
                place = int(p.groups.chip[g]), float(p.groups.epoch[g])
                which, values = columns.deviations.at(int(g), *place, phi[here], columns.centre)
                moved.append((n_sparse_params + which, values))
            row = 2 * here[:, None, None] + np.arange(2)[:, None]
            for at, values in moved:
                parts = (values, row, at)
                entries.append([np.broadcast_to(part, values.shape).ravel() for part in parts])
        data, row, at = (np.concatenate(part) for part in zip(*entries, strict=True))
        sparse = csr_array((data, (row, at)), shape=(2 * n, columns.n_sparse))
        star, by_star = p.star[rows] - first, back[group] @ places_by_star(p, rows)
        frame = structure.linear[group]
        yield Piece(slice(first, last), rows, star, by_star, frame, tuple(dense), sparse)
        first = last


@dataclass(frozen=True, eq=False)
class Absorbed:
    """Parts of the information and score of a piece that its stars absorb."""

    rows: Float  # A^-1/2 T (S q, columns), by internal columns
    right: Float  # A^-1/2 b (S q,)


def without_parameters(solution: SelfCalibrationMode, N: Float, score: Float) -> EfficientScore:
    """Columns other than the parameters, these eliminated as free in the solution, with its priors.

    N and `score` are those of `eliminated`.
    """
    D, prior = len(solution.theta), solution.prior
    free = np.ix_(solution.free, solution.free)
    root = determined(N[free] + prior.precision[free], UNKNOWN)
    covariance = np.zeros((D, D))
    covariance[free] = root @ root.T
    nuisance = score[:D] + prior.pull(solution.theta)
    return EfficientScore.of(covariance, nuisance, N[:D, D:], N[D:, D:], score[D:])


def absorbed_by_stars(
    columns: Columns, piece: Piece, scores: DetectionScores, stars: Float
) -> Absorbed:
    """Sums over the detections of each star of a piece, the stars (S, q) where the scores are."""
    priors = columns.problem.priors
    precision = priors.precision[piece.stars]
    pull = np.einsum("skq,sq->sk", precision, priors.centre[piece.stars] - stars[piece.stars])
    S, q = pull.shape
    S_H = np.swapaxes(piece.by_star, 1, 2) @ scores.curvature  # (n, q, 2)
    own = precision + sums_over(piece.star, S_H @ piece.by_star, S)
    gradient = np.einsum("naq,na->nq", piece.by_star, scores.gradient)
    b = sums_over(piece.star, gradient, S) - pull
    T = np.zeros((S * q, columns.sparse.stop))
    for code, (here, values) in enumerate(piece.dense):
        for axis in (0, 1):
            summed = piece.of_stars(S_H[:, :, axis, None])[:, here] @ values
            T[:, columns.dense(code, axis)] = summed
    T[:, columns.sparse] = (piece.of_stars(S_H) @ piece.sparse).toarray()
    roots = inverse_roots(own)
    rows = np.reshape(roots @ T.reshape(S, q, -1), (S * q, -1))
    return Absorbed(rows, np.ravel(np.einsum("skq,sq->sk", roots, b)))


def eliminated(
    columns: Columns,
    scores: DetectionScores,
    stars: Float,
    *,
    working: DetectionScores | None = None,
) -> tuple[Float, Float, Float]:
    """Information (n, n) and score (n,) of all columns with the stars (S, q) eliminated.

    The third result (D, n) is the information of parameters and all columns by the `working`
    likelihood, that of the solution, where it differs from that of the scores.
    """
    p, n = columns.problem, columns.sparse.stop
    total, score = np.zeros((n, n)), np.zeros(n)
    narrow = Columns(p, columns.theta)
    inside = np.concatenate(
        [
            *(
                np.arange(n)[columns.dense(c, a)][: p.model.n_terms]
                for c in range(len(columns.widths))
                for a in (0, 1)
            ),
            np.arange(columns.sparse.start, columns.sparse.start + narrow.n_sparse),
        ]
    )
    other = np.zeros((len(inside), n))
    for piece in pieces(columns):
        here = piece.scores(scores)
        sums = absorbed_by_stars(columns, piece, here, stars)
        add_products(total, columns, columns, piece, here.curvature)
        total -= sums.rows.T @ sums.rows
        score += _pulled(columns, piece, here.gradient) - sums.rows.T @ sums.right
        if working is not None:
            here = piece.scores(working)
            sums = absorbed_by_stars(columns, piece, here, stars)
            add_products(other, narrow, columns, piece, here.curvature)
            other -= sums.rows[:, inside].T @ sums.rows
    if working is None:
        other = total[inside]
    total = total[np.ix_(columns.order, columns.order)]
    return (total + total.T) / 2, score[columns.order], other[narrow.order][:, columns.order]


def add_products(N: Float, left: Columns, right: Columns, piece: Piece, H: Float) -> None:
    """Add Z^T H Z of a piece to N, by internal columns; `left` may lack the dense functions."""
    n, others = len(piece), left.n_sparse
    across = np.arange(2 * n).reshape(n, 2)
    for code, (here, values) in enumerate(piece.dense):
        some = values[:, : left.widths[code]]
        for a in (0, 1):
            # of dense columns along the axis a with the sparse ones
            turn = csr_array(
                (
                    H[here, :, a].ravel(),
                    (np.repeat(np.arange(len(here)), 2), across[here].ravel()),
                ),
                shape=(len(here), 2 * n),
            )
            moved = (turn @ piece.sparse).T.tocsr()
            N[left.dense(code, a), right.sparse] += (moved @ some).T
            N[left.sparse, right.dense(code, a)] += (moved @ values)[:others]
            for b in (0, 1):
                if left is right and b < a:
                    continue
                product = some.T @ (H[here, a, b, None] * values)
                N[left.dense(code, a), right.dense(code, b)] += product
                if left is right and b > a:
                    N[left.dense(code, b), right.dense(code, a)] += product.T
    blocks = csr_array(
        (H.ravel(), (np.repeat(across, 2), np.repeat(across, 2, axis=0).ravel())),
        shape=(2 * n, 2 * n),
    )
    N[left.sparse, right.sparse] += (piece.sparse.T @ (blocks @ piece.sparse)).toarray()[:others]


def _pulled(columns: Columns, piece: Piece, gradient: Float) -> Float:
    """Sums (n,) of Z^T g over a piece, by internal columns."""
    out = np.zeros(columns.sparse.stop)
    for code, (here, values) in enumerate(piece.dense):
        for axis in (0, 1):
            out[columns.dense(code, axis)] = values.T @ gradient[here, axis]
    out[columns.sparse] = piece.sparse.T @ gradient.ravel()
    return out
