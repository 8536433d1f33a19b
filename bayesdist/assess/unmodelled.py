"""Structure that a polynomial leaves out: how large it is at a place, the stars' noise apart.

Two stars of one exposure that lie close together have nothing in common but what the model leaves
out there.  With g the gradient of a star's log-likelihood and h its curvature, an offset d of the
model gives g the mean h d, so that over pairs of different stars in the same small cell

    sum g_i g_j / sum h_i h_j

is the mean square of what is left out, without the noise and without its error.  What the fit has
taken of it, the variance of the model's position, is added again.  Pairs in cells twice and four
times as wide tell how much the structure has changed within a cell: the parabola through the three
is taken at zero.  It is a line for structure with edges, and begins flat for smooth structure.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import norm

from bayesdist.assess.mean_square import MeanSquare
from bayesdist.assess.star_pairs import AXES, WIDER, pair_sums
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.robust.cells import Cells
from bayesdist.infer.robust.ratios import PositionSigmas
from bayesdist.infer.robust.result import RobustCovariance
from bayesdist.infer.robust.scores import scores_of
from bayesdist.infer.shards import Compute, Matches, Shards, opened
from bayesdist.infer.views import Solution

__all__ = ["Unmodelled", "total_errors", "unmodelled"]

Float = NDArray[np.float64]

# Side of the cells in which stars are paired, in sides of the cells of the covariance: a quarter,
# but not quite, lest all of them lie alike towards a pattern that repeats.
SHARE = 0.23
FEWEST = 30  # pairs of stars that say something, and
MANY = 100  # so many that larger cells are not needed
SOME = 8  # exposures, and
GRID = 9  # points of each axis over which variances of the model's position are averaged


@dataclass(frozen=True, eq=False)
class Unmodelled:
    """Mean square of what the model leaves out on one chip.

    Parameters
    ----------
    chip : int
        Chip number.
    side : float
        Of the cells in which stars were paired, in pixels.
    n_pairs : int
    variance, error : ndarray, shape (2,)
        Of u and v along the axes of the polynomials, in their squared unit, and standard
        deviations of these numbers; a variance may come out below zero.
    covariance, covariance_error : float
        Of u with v.
    drawn : ndarray, shape (2,)
        Of u and v: the part of the variance by which the fit was drawn towards it, on the mean.
    """

    chip: int
    side: float
    n_pairs: int
    variance: Float
    error: Float
    covariance: float
    covariance_error: float
    drawn: Float = field(default_factory=lambda: np.zeros(2))

    @property
    def rms(self) -> Float:
        """Rms of both axes (2,): a term of an error budget, independent from place to place."""
        return np.sqrt(np.maximum(self.variance, 0.0))

    @property
    def beside(self) -> MeanSquare:
        """What has to be added to the errors of the model's positions.

        Where the fit was drawn towards the structure its position errs by that much, and by that
        much less is left out.  With d the variance of it, the sum v of the structure's and d are
        too large by 2 d.
        """
        return MeanSquare(self.variance - 2 * self.drawn, self.error)

    @property
    def rms_error(self) -> Float:
        """Standard deviation of the rms (2,)."""
        return self.error / (2 * np.sqrt(np.maximum(self.variance, self.error)))

    @property
    def found(self) -> NDArray[np.bool_]:
        """Where the variance is above zero by more than three of its errors (2,)."""
        return np.asarray(self.variance > 3 * self.error)

    def limit(self, probability: float = 0.95) -> Float:
        """Rms (2,) that is not exceeded with this probability."""
        upper = self.variance + norm.ppf(probability) * self.error
        return np.sqrt(np.maximum(upper, 0.0))


def unmodelled(
    matches: Matches | Shards,
    solution: Solution,
    cells: Cells,
    *,
    robust: RobustCovariance | None = None,
    side: float | None = None,
    compute: Compute | None = None,
) -> tuple[Unmodelled, ...]:
    """What a solution leaves out at a place: one pass over the stars.

    Stars are paired within an exposure, where the model has frames or dates to tell exposures
    apart.  Where it has not, a star that is listed several times meets itself, and the error of
    the catalogue counts as structure.

    Parameters
    ----------
    matches : MatchTable, PartitionedMatches or Shards
    solution : Posterior, LinearFit or HierarchicalFit
    cells : Cells
        The smallest that `robust_covariance` is given: they set the side.
    robust : RobustCovariance, optional
        Says what the fit took of the structure; without it the variances are too small by that.
        The error is that of a jackknife over its cells, or else `cells`, two by two.
    side : float, optional
        Side of the cells in which stars are paired, in pixels; by default about a
        quarter of the shortest of `cells`, and up to all of it where stars are few.
    compute : Compute, optional

    Returns
    -------
    tuple of Unmodelled
        One for each chip.

    Raises
    ------
    InputError
        For a side that is not positive, or a view of a solution.
    DegenerateError
        For a chip with fewer than 30 pairs of stars in the same cell.
    """
    model = solution.model
    given = side is not None
    side = SHARE * cells.sides(model)[0] if side is None else side
    if not 0 < side < np.inf:
        raise InputError(f"the side is {side} pixels", where="side", do="give a positive number")
    blocks = cells if robust is None else robust.cells
    shapes, into = blocks.merged(2)
    with opened(model, matches, compute) as shards:
        sums = shards.sum(pair_sums, scores_of(solution), side, blocks)
        while not given and sums.n_pairs.min() < MANY and 2 * side < cells.sides(model)[0]:
            side *= 2
            sums = shards.sum(pair_sums, scores_of(solution), side, blocks)
    out = []
    for k, chip in enumerate(model.chips):
        if sums.n_pairs[k] < FEWEST:
            raise DegenerateError(
                f"only {sums.n_pairs[k]} pairs of stars are less than {side:.0f} pixels apart",
                where=f"chip {chip.number}",
                do="take a larger side",
            )
        parts = np.zeros((2, len(WIDER), shapes[k][0] * shapes[k][1], 3))
        for part, whole in zip(parts, (sums.products[k], sums.weights[k]), strict=True):
            np.add.at(part, (slice(None), into[k]), whole[:, : len(into[k])])
        value, error = _jackknife(*parts)
        drawn = np.zeros(2)
        if robust is not None:
            taken, formal = _taken(robust, k)
            value = value + taken
            drawn = np.maximum(taken - formal, 0.0)[:2]
        found = Unmodelled(
            chip.number,
            side,
            int(sums.n_pairs[k]),
            value[:2],
            error[:2],
            float(value[2]),
            float(error[2]),
            drawn,
        )
        out.append(found)
    return tuple(out)


def _jackknife(products: Float, weights: Float) -> tuple[Float, Float]:
    """Mean products at zero distance (3,) and their errors, from blocks (3, C, 3)."""
    has = (weights[0] > 0).all(axis=1)
    products, weights = products[:, has], weights[:, has]

    def at_zero(top: Float, bottom: Float) -> Float:
        near, far, farthest = top / bottom
        return np.asarray((8 * near - 6 * far + farthest) / 3)

    top, bottom = products.sum(axis=1), weights.sum(axis=1)
    without = at_zero(top[:, None] - products, bottom[:, None] - weights)
    n = len(without)
    spread = (n - 1) / n * ((without - without.mean(axis=0)) ** 2).sum(axis=0)
    return at_zero(top, bottom), np.sqrt(spread)


def _taken(robust: RobustCovariance, chip: int) -> tuple[Float, Float]:
    """Mean variances of the model's positions on a chip (by code), in its exposures: uu, vv, uv.

    As measured, and of independent stars.
    """
    model, groups = robust.model, robust.groups
    whole = robust.formal if robust.whole is None else robust.whole
    x, y = (
        z.ravel()
        for z in np.meshgrid(
            *((np.arange(GRID) + 0.5) * n / GRID + 0.5 for n in model.chips[chip].size)
        )
    )
    here = np.flatnonzero(groups.chip == chip)
    out = []
    for g in here[:: -(-len(here) // SOME)]:
        exposure = int(groups.exposure[g])
        J = model.jacobian(
            robust.mean,
            x,
            y,
            epoch=float(groups.epoch[g]),
            exposure=exposure,
            chip=model.chips[chip].number,
        )
        J = np.linalg.solve(model.frame(robust.mean, exposure)[0], J)
        out.append(
            [
                np.einsum("nad,de,nbe->ab", J, cov, J, optimize=True) / len(x)
                for cov in (robust.of_all, whole)
            ]
        )
    measured, formal = (np.array([mean[a, b] for a, b in AXES]) for mean in np.mean(out, axis=0))
    return measured, formal


def total_errors(
    robust: RobustCovariance,
    left_out: tuple[Unmodelled, ...],
    x: ArrayLike,
    y: ArrayLike,
    *,
    epoch: float | None = None,
    chip: int | None = None,
) -> PositionSigmas:
    """Errors of the model as a prediction of where a pixel truly lies.

    Its coefficients err, and what it leaves out is there beside.  The fit has been drawn towards
    what it leaves out: by how much is known on the mean, and more near corners.

    Parameters
    ----------
    robust : RobustCovariance
    left_out : tuple of Unmodelled
    x, y : array_like, shape (N,)
        FITS 1-based pixels.
    epoch, chip
        As in `DistortionModel.predict`.

    Returns
    -------
    PositionSigmas
        `formal` is that of the coefficients alone.
    """
    model = robust.model
    number = model.chips[0].number if chip is None else chip
    here = next(one for one in left_out if one.chip == number)
    errors = robust.at(x, y, epoch=epoch, chip=chip)
    variance = errors.sigma**2 + here.beside.mean
    of_variance = 2 * errors.sigma**4 / errors.dof + here.error**2
    dof = np.maximum(2 * variance**2 / of_variance, 1.0)
    return replace(errors, sigma=np.sqrt(variance), dof=dof)
