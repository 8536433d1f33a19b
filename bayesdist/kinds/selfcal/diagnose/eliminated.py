"""Information and scores of a self-calibration with the stars eliminated.

**Elimination.**  The parameters, functions over a chip, and deviations of an exposure displace its
detections, and the fitted positions of stars follow.  Let Z and S be the derivatives of positions
with respect to all these columns and to a star's parameters, and H and g the curvature and gradient
of each detection.  Then the information N and the score of the columns are

    N = sum Z^T H Z - sum_s T^T A^-1 T        T = sum S^T H Z,  A = sum S^T H S + prior
    score = sum Z^T g - sum_s T^T A^-1 b      b = sum S^T g - pull of the prior

where the sums over s include all stars, and those within T, A and b the detections of a star.
Polynomials and functions over a chip are dense columns, parameters of single exposures sparse ones.

**Single detections.**  The scores of the detections, and the fraction of their variance that the
stars absorb, are computed with the stars at their modes.

**Scatter of the stars.**  The scores of a star's detections are summed, and the squares of these
sums give the covariance of the parameters from the scatter of the stars.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from bayesdist.diagnose.correlated.deviations import DeviationColumns, deviation_columns
from bayesdist.diagnose.correlated.information import (
    MAX_BLOCKS,
    MIN_FREE,
    STARS_PER_BLOCK,
    SquaredScores,
    block_ratios,
)
from bayesdist.diagnose.correlated.priors import StructureFunctions
from bayesdist.diagnose.statistics import EfficientScore, sums_over
from bayesdist.infer.equations.scaled import determined
from bayesdist.kinds.selfcal.infer.calibrate import MOST_TAKEN
from bayesdist.kinds.selfcal.infer.elimination import STARS, PlaceDerivatives, memberships
from bayesdist.kinds.selfcal.infer.mode import SelfCalibrationMode
from bayesdist.kinds.selfcal.infer.problem import Problem
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Bool, Float, Int

DETECTIONS = 8192  # per chunk in memory
MAX_DETECTIONS = 60_000  # largest number that is examined
MAX_EXPOSURES = 150  # largest number of exposures with separate deviations
MAX_EXPOSURES_OF_SECOND_ORDER = 80
# relative curvature below which a combination of parameters, or of a star's parameters, counts as
# undetermined
UNKNOWN = 1e-10


@dataclass(frozen=True, eq=False)
class AddedColumns:
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
    theta: Float  # (D,) parameters of the solution

    @classmethod
    def of(cls, solution: SelfCalibrationMode) -> EvenStars:
        """Select every k-th star, such that there are at most `MAX_DETECTIONS` detections."""
        all_stars = solution.problem
        selected = np.arange(0, all_stars.n_stars, int(np.ceil(len(all_stars) / MAX_DETECTIONS)))
        return cls(
            np.isin(all_stars.star, selected),
            all_stars.of_stars(selected),
            solution.stars[selected],
            solution.theta,
        )

    def deviating(self, *, second_order: bool = False) -> DeviationColumns | None:
        """Deviations of their exposures, on request with terms of the second order."""
        groups = self.problem.groups
        return deviation_columns(
            self.problem.model,
            self.theta,
            groups,
            np.bincount(groups.index, minlength=len(groups)).astype(float),
            second_order=second_order,
            most=MAX_EXPOSURES_OF_SECOND_ORDER if second_order else MAX_EXPOSURES,
        )


@dataclass(frozen=True, eq=False)
class EliminatedPiece:
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

    def scores(self, every: SelfcalScores) -> SelfcalScores:
        """Scores of these detections along the axes of the polynomials."""
        in_piece = every.at(self.rows)
        gradient = np.einsum("nab,na->nb", self.frame, in_piece.gradient)
        return SelfcalScores(gradient, self.frame.mT @ in_piece.curvature @ self.frame)

    def __len__(self) -> int:
        return len(self.star)

    def of_stars(self, values: Float) -> csr_array:
        """Matrix (S q, n k) that sums values (n, q, k) of the detections over their stars."""
        n, q, k = values.shape
        row = np.repeat(self.star[:, None] * q + np.arange(q), k)
        column = np.repeat(np.arange(n)[:, None] * k, q, axis=1)[..., None] + np.arange(k)
        shape = (q * (self.stars.stop - self.stars.start), n * k)
        return csr_array((values.ravel(), (row, column.ravel())), shape=shape)


def pieces(columns: AddedColumns) -> Iterator[EliminatedPiece]:
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
        yield EliminatedPiece(slice(first, last), rows, star, by_star, frame, tuple(dense), sparse)
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
    columns: AddedColumns, piece: EliminatedPiece, scores: SelfcalScores, stars: Float
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
    columns: AddedColumns,
    scores: SelfcalScores,
    stars: Float,
    *,
    working: SelfcalScores | None = None,
) -> tuple[Float, Float, Float]:
    """Information (n, n) and score (n,) of all columns, with the stars (S, q) eliminated.

    The third result (D, n) is the information between parameters and all columns according to the
    `working` likelihood, that of the solution, if it differs from the likelihood of the scores.
    """
    p, n = columns.problem, columns.sparse.stop
    total, score = np.zeros((n, n)), np.zeros(n)
    narrow = AddedColumns(p, columns.theta)
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


def add_products(
    N: Float, left: AddedColumns, right: AddedColumns, piece: EliminatedPiece, H: Float
) -> None:
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


def _pulled(columns: AddedColumns, piece: EliminatedPiece, gradient: Float) -> Float:
    """Sums (n,) of Z^T g over a chunk, with internal columns."""
    out = np.zeros(columns.sparse.stop)
    for code, (members, values) in enumerate(piece.dense):
        for axis in (0, 1):
            out[columns.dense(code, axis)] = values.T @ gradient[members, axis]
    out[columns.sparse] = piece.sparse.T @ gradient.ravel()
    return out


@dataclass(frozen=True, eq=False)
class SelfcalScores:
    """Gradient and curvature of each detection's log density with respect to sky position."""

    gradient: Float  # (N, 2)
    # (N, 2, 2) minus the second derivatives; zero for detections with uncertain membership, so that
    # every sum is positive definite
    curvature: Float

    def at(self, rows: slice | Bool) -> SelfcalScores:
        """Scores of the given detections."""
        return SelfcalScores(self.gradient[rows], self.curvature[rows])

    def flattened(self, excess: Float) -> SelfcalScores:
        """Scores of a likelihood with variances multiplied by factors (N,)."""
        return SelfcalScores(
            self.gradient / excess[:, None], self.curvature / excess[:, None, None]
        )


def scores_of_detections(solution: SelfCalibrationMode) -> SelfcalScores:
    """Scores of all detections of a solution, with the stars at their modes."""
    p, mixture = solution.problem, solution.mixture
    member = memberships(p, solution.theta, mixture, solution.stars)
    r = p.places(solution.theta) - p.star_places(solution.stars)
    W = _square(p)
    inverse = 1.0 / (p.var + mixture.jitter**2)
    pulled = inverse[:, None] * np.einsum("nab,nb->na", W, r)
    H = (member * inverse)[:, None, None] * W
    # derivative of the membership with respect to position
    H -= (member * (1 - member))[:, None, None] * (pulled[:, :, None] * pulled[:, None, :])
    good = (H[:, 0, 0] > 0) & (np.linalg.det(H) > 0)
    return SelfcalScores(-member[:, None] * pulled, np.where(good[:, None, None], H, 0.0))


def score_excess(solution: SelfCalibrationMode, scores: SelfcalScores) -> Float:
    """Ratio (N,) of the variance of the scores to their curvature, in blocks of the detector.

    The ratios are corrected for the part of the residuals that stars absorb.  Those of the blocks
    are shrunk to their mean, as for matched stars.
    """
    p = solution.problem
    free = 1.0 - taken_by_stars(solution)
    free *= max(1.0 - len(solution.free) / max(2 * float(free.sum()), 1.0), 0.1)
    to_pixels = np.linalg.inv(_square(p))  # converts squared gradients to pixels
    top = np.einsum("na,nab,nb->n", scores.gradient, to_pixels, scores.gradient) / free
    bottom = np.einsum("nab,nba->n", to_pixels, scores.curvature)
    chip = p.groups.chip[p.groups.index]
    out = np.ones(len(p))
    for code in range(len(p.model.chips)):
        on_chip = np.flatnonzero(chip == code)
        if not len(on_chip) or bottom[on_chip].sum() <= 0:
            continue
        side = int(np.clip(np.sqrt(len(on_chip) / STARS_PER_BLOCK), 1, MAX_BLOCKS))
        block = cell_index(p.X[on_chip], p.Y[on_chip], (side, side))
        out[on_chip] = block_ratios(
            block, np.stack([top, bottom, 2 * free], axis=1)[on_chip], side**2
        )
    return out


def _square(problem: Problem) -> Float:
    return np.asarray(problem.W[:, [0, 1, 1, 2]].reshape(-1, 2, 2))


@dataclass(frozen=True, eq=False)
class StarBlock:
    """A block of stars with their n detections, in detector pixels."""

    rows: slice  # range of detections in the problem
    star: Int  # (n,) index of each detection's star in the block
    member: Float  # (n,) probability of belonging to the star
    # (n,) inverse variance per axis or, with `shape`, on the geometric mean, times that probability
    weight: Float
    residual: Float  # (n, 2) detection minus star
    # (n, q, 2) R B: B is the curvature of the log density with respect to the star's parameters and
    # the detection's pixels, R^T R the inverse of that with respect to the star's parameters
    ties: Float
    shape: Float | None = (
        None  # (n, 2, 2) weights over `weight`; None if they are equal on both axes
    )

    def weighted(self, values: Float) -> Float:
        """Products (n, 2) of the weights of the detections with values (n, 2)."""
        if self.shape is not None:
            values = np.einsum("nab,nb->na", self.shape, values)
        return self.weight[:, None] * values


def star_blocks(solution: SelfCalibrationMode) -> Iterator[StarBlock]:
    """Iterate over the stars of a solution in blocks, with their detections."""
    p, theta, mixture = solution.problem, solution.theta, solution.mixture
    members = memberships(p, theta, mixture, solution.stars)
    weights = members / (p.var + mixture.jitter**2)
    residuals = p.places(theta) - p.star_places(solution.stars)
    for first in range(0, p.n_stars, STARS):
        last = min(first + STARS, p.n_stars)
        rows = slice(int(p.starts[first]), int(p.starts[last]))
        to_pixels = np.linalg.inv(p.jacobians(theta, rows))
        w, star = weights[rows], p.star[rows] - first
        by_star = np.swapaxes(to_pixels @ places_by_star(p, rows), 1, 2)
        shape = None if p.shape is None else p.shape[rows]
        pulled = w[:, None, None] * (by_star if shape is None else by_star @ shape)
        curvature = pulled @ np.swapaxes(by_star, 1, 2)
        information = p.priors.precision[first:last] + sums_over(star, curvature, last - first)
        roots = inverse_roots(information)
        residual = np.einsum("nij,nj->ni", to_pixels, residuals[rows])
        ties = roots[star] @ pulled
        yield StarBlock(rows, star, members[rows], w, residual, ties, shape)


def taken_by_stars(solution: SelfCalibrationMode) -> Float:
    """Fraction (N,) of each detection's variance that its star absorbs, at most `MOST_TAKEN`."""
    out = np.empty(len(solution.problem))
    for block in star_blocks(solution):
        ties = block.ties
        by_weight = ties if block.shape is None else ties @ np.linalg.inv(block.shape)
        square = np.sum(ties * by_weight, axis=(1, 2))
        out[block.rows] = square / (2 * np.maximum(block.weight, np.finfo(float).tiny))
    return np.minimum(out, MOST_TAKEN)


def inverse_roots(matrices: Float) -> Float:
    """Matrices R with R^T R the inverse of each matrix (S, q, q).

    Undetermined directions are left out.
    """
    scale = np.sqrt(np.maximum(np.einsum("sqq->sq", matrices), 1e-300))
    values, vectors = np.linalg.eigh(matrices / (scale[:, :, None] * scale[:, None, :]))
    good = values > UNKNOWN
    roots = np.where(good, np.where(good, values, 1.0) ** -0.5, 0.0)
    return np.asarray(roots[:, :, None] * np.swapaxes(vectors, 1, 2) / scale[:, None, :])


def places_by_star(problem: Problem, rows: slice) -> Float:
    """Derivatives (n, 2, q) of positions with respect to the parameters of their stars."""
    n, q, unit = rows.stop - rows.start, problem.n_star, np.eye(2)
    out = np.broadcast_to(unit, (n, 2, 2))
    if q >= 4:
        out = np.concatenate([out, problem.time[rows, None, None] * unit], axis=2)
    return out if q < 5 else np.concatenate([out, problem.factor[rows, :, None]], axis=2)


def squared_scores(solution: SelfCalibrationMode, scores: SelfcalScores) -> SquaredScores:
    """Sums over the stars of products of their scores, and their expectation.

    0 for fixed parameters.

    The detections of a star share its position, so that their scores are summed.  The leverage is
    that of the star's detections per degree of freedom, beyond the star's parameters.
    """
    p, free = solution.problem, solution.free
    columns = AddedColumns(p, solution.theta)
    root = np.zeros((columns.n_params, len(free)))
    root[free] = np.linalg.inv(np.linalg.cholesky(solution.precision)).T
    inside = np.empty_like(root)
    inside[columns.order] = root
    unbiased, jackknife = np.zeros((2, columns.n_params, columns.n_params))
    products = np.zeros(3)
    for piece in pieces(columns):
        piece_scores = piece.scores(scores)
        sums = absorbed_by_stars(columns, piece, piece_scores, solution.stars)
        S, q = piece.stars.stop - piece.stars.start, p.n_star
        moved = _displacements(columns, piece, inside)
        total_leverage = np.einsum(
            "nab,naf,nbf->n", piece_scores.curvature, moved, moved, optimize=True
        )
        leverage = np.bincount(piece.star, total_leverage, S)
        leverage -= np.sum((sums.rows @ inside) ** 2, axis=1).reshape(S, q).sum(axis=1)
        number = np.maximum(
            2 * np.bincount(piece.star, piece_scores.curvature[:, 0, 0] > 0, S) - q, 1
        )
        mean = np.clip(leverage / number, 0.0, 1 - MIN_FREE)
        psi = star_scores(columns, piece, piece_scores.gradient) / np.sqrt(1 - mean)[:, None]
        unbiased += psi.T @ psi
        square = np.sum((psi @ root) ** 2, axis=1)
        # expected squares of a star are assumed equal for all its degrees of freedom
        products += [square @ square, square @ mean, leverage @ mean]
        psi /= np.sqrt(1 - mean)[:, None]
        jackknife += psi.T @ psi
    prior = np.array(solution.prior.precision)
    expected = np.zeros_like(prior)
    expected[np.ix_(free, free)] = solution.precision - prior[np.ix_(free, free)]
    return SquaredScores(
        root @ root.T,
        expected,
        prior,
        unbiased,
        jackknife,
        (float(products[0]), float(products[1]), float(products[2])),
    )


def star_scores(columns: AddedColumns, piece: EliminatedPiece, gradient: Float) -> Float:
    """Scores (S, n) of each star of a chunk with respect to all columns.

    Stars are at their modes: the gradient with respect to their parameters is zero, so that nothing
    needs to be eliminated.
    """
    S = piece.stars.stop - piece.stars.start
    out = np.zeros((S, columns.sparse.stop))
    # one value per star
    for code, (members, values) in enumerate(piece.dense):
        for axis in (0, 1):
            summed = piece.of_stars(gradient[:, None, axis, None])[:, members] @ values
            out[:, columns.dense(code, axis)] = summed
    out[:, columns.sparse] = (piece.of_stars(gradient[:, None, :]) @ piece.sparse).toarray()
    return out[:, columns.order]


def _displacements(columns: AddedColumns, piece: EliminatedPiece, root: Float) -> Float:
    """Displacements (n, 2, f) of detections due to changes `root` (internal columns, f)."""
    out = np.zeros((len(piece), 2, root.shape[1]))
    for code, (members, values) in enumerate(piece.dense):
        for axis in (0, 1):
            out[members, axis] = values @ root[columns.dense(code, axis)]
    out += (piece.sparse @ root[columns.sparse]).reshape(out.shape)
    return np.asarray(out)
