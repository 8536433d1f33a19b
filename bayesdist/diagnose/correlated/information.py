"""Sums over small cells of the detector: information, and covariance from the scatter of scores.

Scores, curvatures and squared scores are summed in one pass.  The cells are so small that all
functions are nearly constant within a cell.  Later steps therefore do not need the stars again,
however many there are.

The covariance of the parameters follows from the scatter of the stars' scores g, as far as the data
require it.  With A the information of the parameters, the sandwich A^-1 (sum of g g^T) A^-1 is
valid for any variances of single stars, but its elements scatter like sums of squares.  Squared
scores divided by (1 - l)^2, with l the leverage of a star (HC3 of MacKinnon and White 1985, Journal
of Econometrics 29, 305), remain valid if stars of high leverage have larger errors than others, and
are 1 / (1 - l) times too large if all stars are alike.  In that case the likelihood's covariance,
multiplied by one factor for all stars, is exact.

`score_excess` maps the variance of the scores over the detector, relative to the likelihood's
prediction.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bayesdist.diagnose.statistics import sums_over
from bayesdist.infer.equations.normal import NormalEquations
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.equations.scaled import scaled_inverse
from bayesdist.infer.stars.likelihood import Likelihood
from bayesdist.infer.stars.stars import Stars, Sums
from bayesdist.model import DistortionModel, Groups
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Float, Int

# cells along each side of a chip, by the largest number of groups: limits memory and time
SIDES = ((8, 64), (32, 48), (10**9, 32))
COLUMNS = 9  # n, g_u, g_v, h_uu, h_uv, h_vv, g_u^2, g_u g_v, g_v^2
# A star that alone determines a parameter has no residual: its squared score is uninformative.
MIN_FREE = 0.1
STARS_PER_BLOCK = 60
MAX_BLOCKS = 8  # along each side of a chip
MIN_RATIO, MAX_RATIO = 0.25, 100.0


@dataclass(frozen=True, eq=False)
class GroupCells:
    """One group of stars, summed in cells."""

    chip: int  # index of the chip
    epoch: float
    X: Float  # (C,) scaled positions
    Y: Float
    phi: Float  # (C, K) basis of the model at these
    count: Float  # (C,) number of stars
    score: Float  # (C, 2) gradient of the log-likelihood with respect to the model's u and v
    curvature: Float  # (C, 2, 2) minus its second derivatives
    squares: Float  # (C, 2, 2) sums of products of the gradients of single stars
    columns: Int  # (m,) indices of the parameters that change these positions
    derivative: Float  # (2, K, m) derivatives of the effective coefficients with respect to them
    frame: Float  # (2, 2) matrix from the axes of the polynomials to those of u and v

    def onto_parameters(self, values: Float) -> Float:
        """Sums (m, q) of J^T values, for values (C, 2, q) along u and v."""
        block = np.einsum("ck,caq->akq", self.phi, values, optimize=True)
        return np.asarray(np.einsum("akm,akq->mq", self.derivative, block, optimize=True))


@dataclass(frozen=True, eq=False)
class Information:
    """Likelihood of all cells near a solution, to second order."""

    model: DistortionModel
    theta: Float
    sums: CellSums
    priors: GaussianPriors
    # (chips, C, 2) variance of the gradients relative to their curvature, by chip, cell of the
    # square grid and axis; 1 by default, as for a correct likelihood
    excess: Float | None = None

    def groups(self) -> Iterator[GroupCells]:
        """Iterate over all groups."""
        groups = self.sums.groups
        jacobians = self.model.effective_jacobian(self.theta, groups)
        centres = [self.sums.centres(k) for k in range(len(self.model.chips))]
        bases = [
            self.model.basis(chip.number).evaluate_scaled(X, Y)
            for chip, (_, X, Y) in zip(self.model.chips, centres, strict=True)
        ]
        for g, (columns, derivative) in enumerate(jacobians):
            chip, exposure = int(groups.chip[g]), int(groups.exposure[g])
            cells, X, Y = centres[chip]
            sums = self.sums.sums[g, cells]
            filled = np.flatnonzero(sums[:, 0])
            sums = sums[filled]
            curvature = sums[:, [3, 4, 4, 5]].reshape(-1, 2, 2)
            score, squares = sums[:, 1:3], sums[:, [6, 7, 7, 8]].reshape(-1, 2, 2)
            if self.excess is not None:
                root = np.sqrt(self.excess[chip, cells[filled]])
                score = score / root**2
                curvature = curvature / (root[:, :, None] * root[:, None, :])
            yield GroupCells(
                chip,
                float(groups.epoch[g]),
                X[filled],
                Y[filled],
                bases[chip][filled],
                sums[:, 0],
                score,
                curvature,
                squares,
                columns,
                derivative,
                np.asarray(self.model.frame(self.theta, exposure)[0]),
            )

    def _assembled(self, weights: list[Float]) -> Float:
        """Sum (D, D) of J^T W J, for the weights (C, 2, 2) of each group."""
        K = self.model.n_terms
        moments = np.empty((len(weights), 3, K, K))
        for g, (cells, w) in enumerate(zip(self.groups(), weights, strict=True)):
            for k, (a, b) in enumerate(((0, 0), (0, 1), (1, 1))):
                moments[g, k] = cells.phi.T @ (w[:, a, b, None] * cells.phi)
        nothing = np.zeros((len(weights), 2, K))
        equations = NormalEquations(
            moments, nothing, nothing, 0.0, nothing[:, None][:, :0], np.zeros(0), self.sums.groups
        )
        matrix, _ = equations.assemble(self.model, self.theta)
        return matrix.dense()

    @cached_property
    def precision(self) -> Float:
        """Information (D, D) of all parameters, including their priors."""
        matrix = self._assembled([cells.curvature for cells in self.groups()])
        return matrix + self.priors.information(len(self.theta))

    @cached_property
    def covariance(self) -> Float:
        """Inverse (D, D) of `precision`: the formal covariance, if the likelihood is correct."""
        return scaled_inverse(self.precision)

    @cached_property
    def score(self) -> Float:
        """Gradient (D,) of likelihood and priors with respect to all parameters.

        It is zero at a mode without `excess`.  The priors balance the gradient of the stars with
        respect to the deviations of exposures.
        """
        out = self.priors.pull(self.theta)
        for cells in self.groups():
            out[cells.columns] += cells.onto_parameters(cells.score[..., None])[:, 0]
        return out

    def position_covariance(self, cells: GroupCells) -> Float:
        """Covariance (C, 2, 2) of the model's u and v in each cell, from `covariance`."""
        cov = self.covariance[np.ix_(cells.columns, cells.columns)]
        d = cells.derivative
        within = np.einsum("akm,mn,bln->abkl", d, cov, d, optimize=True)
        return np.asarray(np.einsum("ck,abkl,cl->cab", cells.phi, within, cells.phi, optimize=True))

    def leverage(self, cells: GroupCells) -> Float:
        """Fraction (C, 2) of its residual that a star in each cell absorbs, on each axis.

        If errors are correlated between u and v, it is the mean of both axes.
        """
        return self._leverage(cells, self.position_covariance(cells))

    def _leverage(self, cells: GroupCells, position: Float) -> Float:
        """Leverage (C, 2) for a covariance (C, 2, 2) of positions."""
        products = cells.curvature * position / cells.count[:, None, None]
        out = np.einsum("caa->ca", products)
        if self.sums.n_correlated:
            out = np.repeat(products.sum(axis=(1, 2))[:, None] / 2, 2, axis=1)
        return np.asarray(np.clip(out, 0.0, 1 - MIN_FREE))

    def squared_scores(self) -> SquaredScores:
        """Sums over the stars of products of their scores, and the expectation of these sums."""
        unbiased, jackknife, products = [], [], np.zeros(3)
        for cells in self.groups():
            position = self.position_covariance(cells)
            free = 1 - self._leverage(cells, position)
            product = free[:, :, None] * free[:, None, :]
            unbiased.append(cells.squares / np.sqrt(product))
            jackknife.append(cells.squares / product)
            # Stars of one cell are taken together. They scatter more than single stars only if they
            # are many, and then the scatter of all is negligible.
            X, H = position @ unbiased[-1], position @ cells.curvature
            products += [np.einsum("cab,cba->", *pair) for pair in ((X, X), (X, H), (H, H))]
        prior = self.priors.information(len(self.theta))
        return SquaredScores(
            self.covariance,
            self.precision - prior,
            prior,
            self._assembled(unbiased),
            self._assembled(jackknife),
            (float(products[0]), float(products[1]), float(products[2])),
        )


@dataclass(frozen=True, eq=False)
class CellSums(Sums):
    """Sums over the stars of each group and cell."""

    groups: Groups
    side: int  # number of cells along each side of a chip
    # (G, C, 9) number of stars, gradient of the log-likelihood with respect to the model's u and v,
    # minus its second derivatives uu, uv, vv, and products of the gradients uu, uv, vv
    sums: Float
    position: Float  # (chips, C, 3) number of stars and sums of their scaled positions X and Y
    n_correlated: int  # number of stars in parts with errors that are correlated between u and v

    BY_GROUP = ("sums",)
    SAME = ("side",)

    def centres(self, chip: int) -> tuple[Int, Float, Float]:
        """Indices of a chip's cells with stars (chip by code), and mean scaled X and Y in each."""
        n, x, y = self.position[chip].T
        used = np.flatnonzero(n)
        return used, x[used] / n[used], y[used] / n[used]


def scores_on_chips(
    model: DistortionModel, stars: Stars, likelihood: Likelihood
) -> tuple[Float, Float, Int]:
    """Scores (N, 2) and curvatures (N, 2, 2) along the axes of the polynomials, and chips (N,).

    The chip of each detection is a code, or -1 if its log-likelihood is not concave.
    """
    g_u, g_v, h_uu, h_uv, h_vv = likelihood.scores(stars)
    g = np.stack([g_u, g_v], axis=1)
    h = np.stack([h_uu, h_uv, h_uv, h_vv], axis=1).reshape(-1, 2, 2)
    chip = np.full(len(g), -1)
    for k, (code, exposure) in enumerate(
        zip(stars.groups.chip, stars.groups.exposure, strict=True)
    ):
        rows = slice(stars.starts[k], stars.starts[k + 1])
        frame = np.asarray(model.frame(likelihood.theta, int(exposure))[0])
        g[rows] = g[rows] @ frame
        h[rows] = frame.T @ h[rows] @ frame
        chip[rows] = code
    chip[~((h_uu > 0) & (h_vv > 0))] = -1
    return g, h, chip


def cells_per_side(n_groups: int) -> int:
    """Number of cells along each side of a chip for this number of groups."""
    return next(side for largest, side in SIDES if n_groups <= largest)


def cell_sums(
    stars: Stars, likelihood: Likelihood, side: int, excess: Float | None = None
) -> CellSums:
    """Sums over stars with `side` cells along each side of a chip, as a task for `Shards.sum`.

    `excess` (N,) is the variance of the gradient of each star relative to its curvature, by which
    both are divided; 1 by default.
    """
    columns_of_stars = likelihood.scores(stars)
    if excess is not None:
        columns_of_stars = columns_of_stars / excess
    g_u, g_v, h_uu, h_uv, h_vv = columns_of_stars
    # The curvature is negative for stars with an uncertain membership. It is set to zero for them,
    # so that every sum of curvatures is positive.
    good = (h_uu > 0) & (h_vv > 0)
    h_uu, h_uv, h_vv = (np.where(good, h, 0.0) for h in (h_uu, h_uv, h_vv))
    columns = (None, g_u, g_v, h_uu, h_uv, h_vv, g_u**2, g_u * g_v, g_v**2)
    code, C, G = cell_index(stars.X, stars.Y, (side, side)), side * side, len(stars.groups)
    sums = np.zeros((G, C, COLUMNS))
    position = np.zeros((len(stars.model.chips), C, 3))
    for g, chip in enumerate(stars.groups.chip):
        rows = slice(stars.starts[g], stars.starts[g + 1])
        for k, column in enumerate(columns):
            weights = None if column is None else column[rows]
            sums[g, :, k] = np.bincount(code[rows], weights, minlength=C)
        position[chip, :, 0] += sums[g, :, 0]
        for k, z in ((1, stars.X), (2, stars.Y)):
            position[chip, :, k] += np.bincount(code[rows], z[rows], minlength=C)
    n_correlated = len(stars) if stars.is_correlated else 0
    return CellSums(stars.groups, side, sums, position, n_correlated)


@dataclass(frozen=True, eq=False)
class SquaredScores:
    """Information from the scores of the stars, and that expected from the likelihood.

    X : Y below is the sum over stars of trace(A^-1 X_i A^-1 Y_i), where X_i and Y_i are a star's
    contributions to two sums and A is the information of the parameters.
    """

    covariance: Float  # (D, D) A^-1 of the parameters, from likelihood and priors
    expected: Float  # (D, D) information of the likelihood: expectation of the sum of squares
    prior: Float  # (D, D) information of the priors
    # (D, D) from scores divided by sqrt(1 - l) (HC2): unbiased if all stars are alike
    unbiased: Float
    jackknife: Float  # (D, D) from scores divided by 1 - l (HC3)
    # unbiased : unbiased, unbiased : expected, and expected : expected
    products: tuple[float, float, float]

    @cached_property
    def scale(self) -> float:
        """Mean ratio of the squares to their expectation."""
        return float(np.sum(self.covariance * self.unbiased)) / float(
            np.sum(self.covariance * self.expected)
        )

    @cached_property
    def weight(self) -> float:
        """Weight of the sandwich: 0 if the variances of the stars show no differences.

        Let d be the squared distance of the unbiased sum from `scale` times the expected one, and b
        the part of d due to the scatter of single squares.  Then 1 - b / d is the weight of linear
        shrinkage with the smallest expected squared error (Ledoit and Wolf 2004, Journal of
        Multivariate Analysis 88, 365; James and Stein's estimator as an empirical Bayes estimate:
        Efron and Morris 1973, Journal of the American Statistical Association 68, 117).  It is
        doubled, because errors that are too small are worse than errors that are too large: only
        the sandwich is used if chance explains less than half of the difference.  Distances are
        measured in units of the likelihood's covariance, which replaces Ledoit and Wolf's identity
        matrix, so that the result does not depend on the parametrisation.
        """
        whitened = self.covariance @ (self.unbiased - self.scale * self.expected)
        distance = float(np.sum(whitened * whitened.T))
        squares, crossed, expected = self.products
        by_chance = squares - 2 * self.scale * crossed + self.scale**2 * expected
        return float(np.clip(2 * (1 - by_chance / distance), 0.0, 1.0)) if distance > 0 else 0.0

    def sandwich(self, weight: float = 1.0) -> Float:
        """Covariance (D, D) with this weight of the jackknife and the rest from the likelihood."""
        meat = weight * self.jackknife + (1 - weight) * self.scale * self.expected + self.prior
        return np.asarray(self.covariance @ meat @ self.covariance)

    @property
    def by_evidence(self) -> Float:
        """Covariance (D, D) with the weight `weight`."""
        return self.sandwich(self.weight)


def score_excess(information: Information) -> Float:
    """Ratio (chips, C, 2) of the variance of the scores to their curvature, by chip, cell and axis.

    It is 1 for a correct likelihood.  Ratios of blocks of the detector are shrunk to their mean
    according to their errors and their scatter (a normal model of their logarithms, by moments:
    DerSimonian and Laird 1986, Controlled Clinical Trials 7, 177).
    """
    side, n_chips = information.sums.side, len(information.model.chips)
    stars = information.sums.position[:, :, 0].sum(axis=1)
    blocks = np.clip(np.sqrt(stars / STARS_PER_BLOCK).astype(int), 1, MAX_BLOCKS)
    # squared scores and curvatures along both axes, and the number of stars
    sums = np.zeros((n_chips, side * side, 5))
    for cells in information.groups():
        free = 1 - information.leverage(cells)
        squares, curvature = (
            np.einsum("caa->ca", matrix) for matrix in (cells.squares, cells.curvature)
        )
        values = np.column_stack([squares / free, curvature, cells.count])
        sums[cells.chip] += sums_over(
            cell_index(cells.X, cells.Y, (side, side)), values, side * side
        )
    out = np.ones((n_chips, side * side, 2))
    index = np.arange(side)
    for chip in range(n_chips):
        b = int(blocks[chip])
        block = ((index[:, None] * b // side) * b + index * b // side).ravel()
        for a in (0, 1):
            out[chip, :, a] = block_ratios(block, sums[chip][:, [a, 2 + a, 4]], b * b)
    return out


def block_ratios(block: Int, values: Float, n: int) -> Float:
    """Ratios (N,) of the sums over n blocks of squares and curvatures, shrunk to their mean.

    `block` (N,) is the block of each row of `values` (N, 3): square, curvature, number.
    """
    top, bottom, number = sums_over(block, values, n).T
    mean = top.sum() / bottom.sum()
    good = (number >= STARS_PER_BLOCK / 6) & (bottom > 0) & (top > 0)
    out = np.full(n, mean)
    if good.sum() > 1:
        ratio = np.log(top[good] / bottom[good] / mean)
        # the square of a normal variable has variance 2; mixtures have a larger one
        variance = 2.5 / number[good]
        w = 1 / variance
        q = (w * (ratio - np.average(ratio, weights=w)) ** 2).sum()
        scatter = max(0.0, (q - (len(w) - 1)) / (w.sum() - (w**2).sum() / w.sum()))
        out[good] = mean * np.exp(ratio * scatter / (scatter + variance))
    return np.asarray(np.clip(out, MIN_RATIO, MAX_RATIO)[block])


def not_narrower(noise: Float, formal: Float) -> tuple[Float, float]:
    """Covariance from the stars' scatter, at least as large as the formal one, and their ratio.

    Both are (D, D), with zeros for fixed parameters.  The formal covariance is the lower limit
    because residuals cannot distinguish quoted errors that are too large from truncated matches.
    """
    # a small part of the formal covariance, so that no direction has zero variance
    noise = 0.99 * noise + 0.01 * formal
    free = np.flatnonzero(np.diag(formal) > 0)
    inner = np.ix_(free, free)
    ratio = float(np.sum(scaled_inverse(formal[inner]) * noise[inner])) / len(free)
    return noise * max(1.0, 1 / ratio), ratio
