"""What is to be known of all stars at a solution, as sums that take one pass over the data.

The functions that go over a shard are those of a module, so that they can be sent to other
processes; what they return adds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.residuals import BinnedSums, binned_sums
from bayesdist.infer.kernel import Constants
from bayesdist.infer.linear import Clip
from bayesdist.infer.membership import averaged_draws, star_averages
from bayesdist.infer.posterior import Posterior
from bayesdist.infer.shards import Shards
from bayesdist.infer.stars import Stars

__all__ = ["ExposureSums", "StarSums", "flagged_by_exposure", "star_sums"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bins = tuple[int, int]


@dataclass(frozen=True, eq=False)
class ExposureSums:
    """Counts and residuals of each exposure.

    Parameters
    ----------
    n, n_used : ndarray of int, shape (E,)
        Stars, and those that the least-squares fit used.
    uu, vv : ndarray, shape (E,)
        Sums of the squared residuals of the stars used.
    """

    n: Int
    n_used: Int
    uu: Float
    vv: Float

    def __add__(self, other: ExposureSums) -> ExposureSums:
        names = ("n", "n_used", "uu", "vv")
        return ExposureSums(*(getattr(self, n) + getattr(other, n) for n in names))

    @property
    def rms(self) -> tuple[Float, Float]:
        """Rms residuals in u and in v of the stars used; NaN where there are none."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(self.uu / self.n_used), np.sqrt(self.vv / self.n_used)


@dataclass(frozen=True, eq=False)
class StarSums:
    """Sums over stars at a solution.

    Parameters
    ----------
    binned : mapping of (int, int) to BinnedSums
        Residuals of the stars used on the first chip, by the numbers of bins on x and y.
    exposures : ExposureSums
    """

    binned: Mapping[Bins, BinnedSums]
    exposures: ExposureSums

    def __add__(self, other: StarSums) -> StarSums:
        binned = {bins: sums + other.binned[bins] for bins, sums in self.binned.items()}
        return StarSums(binned, self.exposures + other.exposures)


def star_sums(stars: Stars, theta: Float, clip: Clip, partitions: tuple[Bins, ...]) -> StarSums:
    """Sums over some stars: a task for `Shards.sum`.

    Parameters
    ----------
    stars : Stars
    theta : ndarray, shape (D,)
        Where the residuals are taken.
    clip : Clip
        Says which stars are used.
    partitions : tuple of (int, int)
        Bins on x and on y of the first chip.

    Returns
    -------
    StarSums
    """
    used = clip.keeps_of(stars)
    residual = stars.residuals(theta)
    exposures = _exposure_sums(stars, used, residual)
    good = used & (_of_groups(stars, stars.groups.chip) == 0)
    arrays = (*stars.pixels(), *residual.T)
    if not good.all():
        arrays = tuple(a[good] for a in arrays)
    size = stars.model.chips[0].size
    binned = {bins: binned_sums(*arrays, bins=bins, size=size) for bins in partitions}
    return StarSums(binned, exposures)


def flagged_by_exposure(shards: Shards, posterior: Posterior) -> Int:
    """Stars (E,) of each exposure that are more likely false matches than not.

    Parameters
    ----------
    shards : Shards
        Of all stars; one pass over them is made.
    posterior : Posterior
    """
    return shards.sum(_flagged, *averaged_draws(posterior))


def _flagged(stars: Stars, theta: Float, constants: Constants) -> Int:
    p = star_averages(stars, theta, constants)[0]
    exposure = _of_groups(stars, stars.groups.exposure)
    return np.bincount(exposure[p > 0.5], minlength=len(stars.model.exposures))


def _of_groups(stars: Stars, codes: Int) -> Int:
    """What belongs to each star's group."""
    return np.repeat(codes, np.diff(stars.starts))


def _exposure_sums(stars: Stars, used: NDArray[np.bool_], residual: Float) -> ExposureSums:
    exposure, n = _of_groups(stars, stars.groups.exposure), len(stars.model.exposures)
    of_used = exposure[used]
    u, v = residual[used].T
    return ExposureSums(
        n=np.bincount(exposure, minlength=n),
        n_used=np.bincount(of_used, minlength=n),
        uu=np.bincount(of_used, u * u, minlength=n),
        vv=np.bincount(of_used, v * v, minlength=n),
    )
