"""Information and scores of parameters and added functions, with the stars eliminated.

The parameters, functions over a chip, and deviations of an exposure displace its detections, and
the fitted positions of stars follow.  Let Z and S be the derivatives of positions with respect to
all these columns and to a star's parameters, and H and g the curvature and gradient of each
detection.  Then

    N = sum Z^T H Z - sum_s T^T A^-1 T        T = sum S^T H Z,  A = sum S^T H S + prior
    score = sum Z^T g - sum_s T^T A^-1 b      b = sum S^T g - pull of the prior

where the sums over s include all stars, and those within T, A and b the detections of a star.
Polynomials and functions over a chip are dense columns, parameters of single exposures sparse ones.
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

DETECTIONS = 8192  # per chunk in memory
MAX_DETECTIONS = 60_000  # largest number that is examined
MAX_EXPOSURES = 150  # largest number of exposures with separate deviations


@dataclass(frozen=True, eq=False)
class Columns:
    """Displacements of detections by parameters, functions over chips and deviations of exposures.

    This is the order of the columns in all matrices.  Functions are sorted by chip, those along u
    before those along v.  `functions` maps chip codes to functions; it is empty by default.
    """

    problem: Problem
    theta: Float
    functions: Mapping[int, StructureFunctions] = field(default_factory=dict)
    deviations: DeviationColumns | None = None

    @cached_property
    def structure(self) -> PlaceDerivatives:
        """Derivatives of positions with respect to the parameters."""
        return PlaceDerivatives.at(self.problem, self.theta)

    @property
    def n_params(self) -> int:
        """Number of parameters."""
        return self.problem.model.n_params

    def n_functions(self, chip: int) -> int:
        """Number of functions over a chip (by code) along one axis."""
        return self.functions[chip].n_known if chip in self.functions else 0

    def values(self, chip: int, rows: Int) -> Float:
        """Values (n, n_functions) of the functions at detections on the chip."""
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
        """Number of deviations, and of parameters that are not polynomial coefficients."""
        non_polynomial = self.n_params - self.problem.model.n_polynomial
        return non_polynomial + (0 if self.deviations is None else len(self.deviations))

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
        sparse_columns = np.arange(self.sparse.start, self.sparse.stop)
        n = self.n_params - self.problem.model.n_polynomial
        parts = [
            *(columns[:K] for columns in inside),
            sparse_columns[:n],
            *(columns[K:] for columns in inside),
        ]
        return np.concatenate([*parts, sparse_columns[n:]])

    @cached_property
    def centre(self) -> Float:
        """Mean position of the exposures along the polynomial axes.

        0 without deviations of exposures.
        """
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
    """All stars of a solution, or an unbiased subset."""

    rows: Bool  # (N,) mask of their detections among those of all stars
    problem: Problem
    stars: Float  # (S, q)
    deviations: DeviationColumns | None  # deviations of their exposures

    @classmethod
    def of(cls, solution: SelfCalibrationMode) -> EvenStars:
        """Select every k-th star, such that there are at most `MAX_DETECTIONS` detections."""
        all_stars = solution.problem
        selected = np.arange(0, all_stars.n_stars, int(np.ceil(len(all_stars) / MAX_DETECTIONS)))
        problem = all_stars.of_stars(selected)
        groups = problem.groups
        counts = np.bincount(groups.index, minlength=len(groups)).astype(float)
        deviations = deviation_columns(
            all_stars.model, solution.theta, groups, counts, most=MAX_EXPOSURES
        )
        return cls(np.isin(all_stars.star, selected), problem, solution.stars[selected], deviations)


@dataclass(frozen=True, eq=False)
class Piece:
    """A chunk of stars with their n detections, displaced along the axes of the polynomials."""

    stars: slice  # range of stars in the problem
    rows: slice  # range of their detections in the problem
    star: Int  # (n,) index of each detection's star in the chunk
    # (n, 2, q) derivatives of positions with respect to the parameters of their stars
    by_star: Float
    frame: Float  # (n, 2, 2) matrix from the axes of the polynomials to those of the sky
    # for each chip, the indices of its detections and the values of its columns
    dense: tuple[tuple[Int, Float], ...]
    sparse: csr_array  # (2 n, n_sparse) displacements along both axes in turn

    def scores(self, every: DetectionScores) -> DetectionScores:
        """Scores of these detections along the axes of the polynomials."""
        in_piece = every.at(self.rows)
        gradient = np.einsum("nab,na->nb", self.frame, in_piece.gradient)
        return DetectionScores(gradient, self.frame.mT @ in_piece.curvature @ self.frame)

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
    """Iterate over the detections in chunks of stars."""
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
            members = np.flatnonzero(chip == code)
            phi[members] = basis.evaluate_scaled(p.X[rows][members], p.Y[rows][members])
            added = columns.values(code, rows.start + members)
            dense.append((members, np.concatenate([phi[members], added], axis=1)))
        entries = []
        back = np.linalg.inv(structure.linear)
        for g in np.unique(group):
            members = np.flatnonzero(group == g)
            # parameters of exposures and drifts
            used = np.flatnonzero(structure.columns[g] >= 0)
            values = np.einsum("mak,nk->nam", back[g] @ structure.extra[g][used], phi[members])
            moved = [(structure.columns[g][used] - p.model.n_polynomial, values)]
            if columns.deviations is not None:
                place = int(p.groups.chip[g]), float(p.groups.epoch[g])
                indices, values = columns.deviations.at(
                    int(g), *place, phi[members], columns.centre
                )
                moved.append((n_sparse_params + indices, values))
            row = 2 * members[:, None, None] + np.arange(2)[:, None]
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
    """Contributions to the information and score of a chunk that its stars absorb."""

    rows: Float  # (S q, columns) A^-1/2 T, with internal columns
    right: Float  # (S q,) A^-1/2 b


def without_parameters(solution: SelfCalibrationMode, N: Float, score: Float) -> EfficientScore:
    """Columns other than the parameters, with the free parameters eliminated.

    The priors of the solution are included.  For N and `score` see `eliminated`.
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
    """Sums over the detections of each star of a chunk.

    `stars` (S, q) are the parameters of the stars.
    """
    priors = columns.problem.priors
    precision = priors.precision[piece.stars]
    pull = np.einsum("skq,sq->sk", precision, priors.centre[piece.stars] - stars[piece.stars])
    S, q = pull.shape
    S_H = np.swapaxes(piece.by_star, 1, 2) @ scores.curvature  # (n, q, 2)
    information = precision + sums_over(piece.star, S_H @ piece.by_star, S)
    gradient = np.einsum("naq,na->nq", piece.by_star, scores.gradient)
    b = sums_over(piece.star, gradient, S) - pull
    T = np.zeros((S * q, columns.sparse.stop))
    for code, (members, values) in enumerate(piece.dense):
        for axis in (0, 1):
            summed = piece.of_stars(S_H[:, :, axis, None])[:, members] @ values
            T[:, columns.dense(code, axis)] = summed
    T[:, columns.sparse] = (piece.of_stars(S_H) @ piece.sparse).toarray()
    roots = inverse_roots(information)
    rows = np.reshape(roots @ T.reshape(S, q, -1), (S * q, -1))
    return Absorbed(rows, np.ravel(np.einsum("skq,sq->sk", roots, b)))


def eliminated(
    columns: Columns,
    scores: DetectionScores,
    stars: Float,
    *,
    working: DetectionScores | None = None,
) -> tuple[Float, Float, Float]:
    """Information (n, n) and score (n,) of all columns, with the stars (S, q) eliminated.

    The third result (D, n) is the information between parameters and all columns according to the
    `working` likelihood, that of the solution, if it differs from the likelihood of the scores.
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
    by_working = np.zeros((len(inside), n))
    for piece in pieces(columns):
        piece_scores = piece.scores(scores)
        sums = absorbed_by_stars(columns, piece, piece_scores, stars)
        add_products(total, columns, columns, piece, piece_scores.curvature)
        total -= sums.rows.T @ sums.rows
        score += _pulled(columns, piece, piece_scores.gradient) - sums.rows.T @ sums.right
        if working is not None:
            piece_scores = piece.scores(working)
            sums = absorbed_by_stars(columns, piece, piece_scores, stars)
            add_products(by_working, narrow, columns, piece, piece_scores.curvature)
            by_working -= sums.rows[:, inside].T @ sums.rows
    if working is None:
        by_working = total[inside]
    total = total[np.ix_(columns.order, columns.order)]
    return (total + total.T) / 2, score[columns.order], by_working[narrow.order][:, columns.order]


def add_products(N: Float, left: Columns, right: Columns, piece: Piece, H: Float) -> None:
    """Add Z^T H Z of a chunk to N, with internal columns; `left` may lack the dense functions."""
    n, n_left_sparse = len(piece), left.n_sparse
    across = np.arange(2 * n).reshape(n, 2)
    for code, (members, values) in enumerate(piece.dense):
        left_values = values[:, : left.widths[code]]
        for a in (0, 1):
            # products of dense columns along the axis a with the sparse columns
            turn = csr_array(
                (
                    H[members, :, a].ravel(),
                    (np.repeat(np.arange(len(members)), 2), across[members].ravel()),
                ),
                shape=(len(members), 2 * n),
            )
            moved = (turn @ piece.sparse).T.tocsr()
            N[left.dense(code, a), right.sparse] += (moved @ left_values).T
            N[left.sparse, right.dense(code, a)] += (moved @ values)[:n_left_sparse]
            for b in (0, 1):
                if left is right and b < a:
                    continue
                product = left_values.T @ (H[members, a, b, None] * values)
                N[left.dense(code, a), right.dense(code, b)] += product
                if left is right and b > a:
                    N[left.dense(code, b), right.dense(code, a)] += product.T
    blocks = csr_array(
        (H.ravel(), (np.repeat(across, 2), np.repeat(across, 2, axis=0).ravel())),
        shape=(2 * n, 2 * n),
    )
    N[left.sparse, right.sparse] += (piece.sparse.T @ (blocks @ piece.sparse)).toarray()[
        :n_left_sparse
    ]


def _pulled(columns: Columns, piece: Piece, gradient: Float) -> Float:
    """Sums (n,) of Z^T g over a chunk, with internal columns."""
    out = np.zeros(columns.sparse.stop)
    for code, (members, values) in enumerate(piece.dense):
        for axis in (0, 1):
            out[columns.dense(code, axis)] = values.T @ gradient[members, axis]
    out[columns.sparse] = piece.sparse.T @ gradient.ravel()
    return out
