"""Sums over all stars at a solution, in one pass over the data.

The functions that process a shard are module-level functions, so that they can be sent to other
processes.  Their results are added.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.diagnose.clusters import joint_clusters
from bayesdist.diagnose.residuals.binned import BinnedSums, binned_sums
from bayesdist.infer.kernel import Constants
from bayesdist.infer.posterior import Posterior
from bayesdist.infer.posterior.memberships import averaged_draws
from bayesdist.infer.stars.likelihood import Likelihood, star_averages
from bayesdist.infer.stars.shards import Shards
from bayesdist.infer.stars.stars import Stars, prepare
from bayesdist.infer.stars.sums import Sums
from bayesdist.model import DistortionModel
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Bool, Float, Int

Bins = tuple[int, int]


@dataclass(frozen=True, eq=False)
class ExposureSums(Sums):
    """Counts and residuals of each exposure."""

    # n, n_used (E,): number of stars, and of those that the least-squares fit used
    n: Int
    n_used: Int
    # uu, vv (E,): sums of the squared residuals of the stars used
    uu: Float
    vv: Float

    @property
    def rms(self) -> tuple[Float, Float]:
        """Rms residuals in u and v of the stars used; NaN without stars."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(self.uu / self.n_used), np.sqrt(self.vv / self.n_used)


@dataclass(frozen=True, eq=False)
class StarSums(Sums):
    """Sums over stars at a solution."""

    # residuals of probably true stars at the solution, by the number of the chip and the numbers of
    # bins in x and y. If exposures have rotated frames, they are along the axes of the polynomials:
    # along those of the sky, effects of the detector would cancel
    binned: Mapping[tuple[int, Bins], BinnedSums]
    exposures: ExposureSums  # at the least-squares fit


def star_sums(
    stars: Stars,
    fit: Likelihood,
    solution: Likelihood,
    partitions: Mapping[int, tuple[Bins, ...]],
) -> StarSums:
    """Sums over stars: a task for `Shards.sum`.

    `fit` is the likelihood of the least-squares fit, and `solution` that of the posterior, or the
    fit again without a posterior: the clipping of a fit may accept false matches that hide effects
    in the residuals of true ones.  `partitions` are the numbers of bins in x and y, by the number
    of the chip.
    """
    used, residual = fit.inliers(stars) > 0.5, stars.residuals(fit.theta)
    exposures = _exposure_sums(stars, used, residual)
    if solution is not fit:
        used, residual = solution.inliers(stars) > 0.5, stars.residuals(solution.theta)
    code = _of_groups(stars, stars.groups.chip)
    arrays = (*stars.pixels(), *_along_gauge(stars, solution.theta, residual).T)
    binned = {}
    for number, several in partitions.items():
        k = stars.model.chip_code(number)
        good = used & (code == k)
        chip_arrays = arrays if good.all() else tuple(a[good] for a in arrays)
        size = stars.model.chips[k].size
        for bins in several:
            binned[number, bins] = binned_sums(*chip_arrays, bins=bins, size=size)
    return StarSums(binned, exposures)


def star_bins(
    table: Matches,
    code: Int,
    model: DistortionModel,
    solution: Likelihood,
    partitions: Mapping[int, tuple[Bins, ...]],
) -> dict[tuple[int, Bins], BinnedSums]:
    """Sums over bins in which the detections of one star count as one, at their mean.

    Detections of a star share the error of its reference position, so that the means of bins
    scatter according to the number of stars.  `code` (N,) is the star of each match, or the tight
    group of stars; for the other arguments see `star_sums`.
    """
    stars, order = prepare(model, table)
    used, residual = solution.inliers(stars) > 0.5, stars.residuals(solution.theta)
    values = np.stack([*stars.pixels(), *_along_gauge(stars, solution.theta, residual).T])
    chip, code = _of_groups(stars, stars.groups.chip), code[order]
    out = {}
    for number, several in partitions.items():
        on_chip = used & (chip == model.chip_code(number))
        size = model.chips[model.chip_code(number)].size
        chip_values, star = values[:, on_chip], code[on_chip]
        for nx, ny in several:
            X, Y = (2 * (chip_values[k] - 0.5) / size[k] - 1 for k in (0, 1))
            cell = cell_index(X, Y, (nx, ny))
            _, of = joint_clusters(cell, star)
            means = [np.bincount(of, z) / np.bincount(of) for z in chip_values]
            out[number, (nx, ny)] = binned_sums(*means, bins=(nx, ny), size=size)
    return out


def _along_gauge(stars: Stars, theta: Float, residual: Float) -> Float:
    """Residuals along the axes of the polynomials, before frames are applied."""
    if not stars.model.n_frame:
        return residual
    out = residual.copy()
    for g, e in enumerate(stars.groups.exposure):
        matrix, _ = stars.model.frame(theta, int(e))
        rows = slice(stars.starts[g], stars.starts[g + 1])
        out[rows] = np.linalg.solve(matrix, residual[rows].T).T
    return out


def flagged_by_exposure(shards: Shards, posterior: Posterior) -> Int:
    """Number (E,) of stars in each exposure that are more likely false matches than true.

    `shards` contains all stars; one pass over them is made.
    """
    return shards.sum(_flagged, *averaged_draws(posterior))


def _flagged(stars: Stars, theta: Float, constants: Constants) -> Int:
    p = star_averages(stars, theta, constants)[0]
    exposure = _of_groups(stars, stars.groups.exposure)
    return np.bincount(exposure[p > 0.5], minlength=len(stars.model.exposures))


def _of_groups(stars: Stars, codes: Int) -> Int:
    """Codes (N,) of the groups, repeated for each of their stars."""
    return np.repeat(codes, np.diff(stars.starts))


def _exposure_sums(stars: Stars, used: Bool, residual: Float) -> ExposureSums:
    exposure, n = _of_groups(stars, stars.groups.exposure), len(stars.model.exposures)
    of_used = exposure[used]
    u, v = residual[used].T
    return ExposureSums(
        n=np.bincount(exposure, minlength=n),
        n_used=np.bincount(of_used, minlength=n),
        uu=np.bincount(of_used, u * u, minlength=n).astype(np.float64),
        vv=np.bincount(of_used, v * v, minlength=n).astype(np.float64),
    )
