"""One row of a residual table: each statistic with its error, and with its noise taken out.

Means of bins hold the mean errors of their stars beside what the model leaves.  Two questions are
answered of every statistic.  Its error: how much it would change with other stars in the same
bins.  Its noise-free value: what it would be with infinitely many of them.

Differences between all pairs of bins are never listed: 45 x 45 bins have four million.  Their mean,
sigma and extremes have closed forms; an order statistic is found by counting: how many differences
lie below a limit is one search in a sorted list for each value.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.diagnose.residuals.binned import BinValues
from bayesdist.errors import DegenerateError, InputError
from bayesdist.utils.arrays import Float

STATISTICS = ("mean", "sigma", "min", "max", "median", "p01", "p99")
DRAWS = 300  # of bins with fresh noise: errors to 4 %
_FEWEST_BINS = 3
# percentiles of pairs in the draws need not be finer than this part of their spread
_COARSE = 1e-3


@dataclass(frozen=True, eq=False)
class StatisticsRow:
    """Statistics of means of bins, or of differences between them."""

    label: str  # as in the report: 'W1/X', 'W2-W1/Y', 'W1/radial', '25-Day/X'
    # by the names in `STATISTICS`, of the means as they are: what the report prints
    value: Mapping[str, float]
    error: Mapping[str, float]  # standard deviation of `value` over the noise of the means
    # `value` less what noise adds on average to a set of this width and shape.  It takes the
    # widening out; shape finer than the noise, on which a median may hang, does not come back. Min,
    # percentiles, median and max stay in their order: they meet where only noise is left
    noise_free: Mapping[str, float]
    variance: float  # what is left of sigma^2 without noise; below zero where chance makes it so
    variance_error: float  # its standard deviation
    # n_bins, n_left_out: bins used, and those without a standard error
    n_bins: int
    n_left_out: int

    @property
    def sigma_noise(self) -> float:
        """The part of sigma that noise makes: sigma^2 is its square plus `variance`."""
        return float(np.sqrt(max(self.value["sigma"] ** 2 - self.variance, 0.0)))


def bin_row(
    label: str, bins: BinValues, *, absorbed: int, rng: np.random.Generator
) -> StatisticsRow:
    """A row of Tables 5-1, 5-2 and C-1 of WSDC D-T033.

    `absorbed` are the coefficients of this axis that the fit took out of the residuals, at least 1:
    they carry away that many degrees of freedom of the noise. Raises `DegenerateError` when too few
    bins hold two stars.
    """
    some = _Bins.of(label, bins, absorbed)
    drawn, calm = _along_last(some.draws(rng)), _along_last(some.centre)
    return _row(label, some, some.value, drawn, calm, 1)


def pair_row(
    label: str, bins: BinValues, *, absorbed: int, rng: np.random.Generator
) -> StatisticsRow:
    """A row of Table 5-3 of WSDC D-T033: differences over all pairs of bins.

    Parameters and errors as of `bin_row`.
    """
    some = _Bins.of(label, bins, absorbed)
    coarse = _COARSE * float(np.hypot(some.value["sigma"], some.value["sigma"]))
    rows = [pair_statistics(one, tolerance=coarse) for one in some.draws(rng)]
    drawn = {name: np.array([row[name] for row in rows]) for name in STATISTICS}
    calm = pair_statistics(some.centre, tolerance=coarse)
    return _row(label, some, pair_statistics(some.mean), drawn, calm, 2)


@dataclass(frozen=True, eq=False)
class _Bins:
    """Used bins, their statistics, and where they would lie without noise."""

    mean: Float
    sem: Float
    value: Mapping[str, float]
    variance: float
    variance_error: float
    n_left_out: int

    @classmethod
    def of(cls, label: str, bins: BinValues, absorbed: int) -> _Bins:
        good = bins.good
        mean, sem, dof = bins.mean[good], bins.sem[good], bins.dof[good]
        n = mean.size
        if n < max(_FEWEST_BINS, absorbed + 1):
            raise DegenerateError(
                f"only {n} bins hold two stars or more",
                where=label,
                do="take fewer bins or more stars",
            )
        # noise that the fit has not taken away, spread over all bins alike
        sem = sem * np.sqrt((n - absorbed) / (n - 1))
        value = {name: float(x) for name, x in _along_last(mean).items()}
        variance = value["sigma"] ** 2 - (1 - 1 / n) * float(np.mean(sem**2))
        error = _variance_error(mean, sem, dof)
        return cls(mean, sem, value, variance, error, good.size - n)

    @property
    def centre(self) -> Float:
        """Values whose distribution is that of the means without their noise.

        Each is drawn to the mean of all by the root of its share of true variance: with fresh
        noise added the set is as wide as the one observed, no wider.
        """
        true = max(self.variance, 0.0)
        total = true + self.sem**2
        share = np.divide(true, total, out=np.ones_like(total), where=total > 0)
        return self.value["mean"] + np.sqrt(share) * (self.mean - self.value["mean"])

    def draws(self, rng: np.random.Generator) -> Float:
        return self.centre + self.sem * rng.standard_normal((DRAWS, self.mean.size))


def _variance_error(mean: Float, sem: Float, dof: Float) -> float:
    """Standard deviation of the variance of bins less their noise.

    The variance is the quadratic form b^T A b with A = (1 - 1 1^T / n) / n of b = m + e, e normal
    with variances S: its variance is 2 tr(A S A S) + 4 m^T A S A m.  The second term is estimated
    from b, less what noise adds to it.  To this comes the error of the noise itself, whose squares
    are known to 2 / dof.
    """
    n = mean.size
    s2 = sem**2
    trace = ((1 - 2 / n) * np.sum(s2**2) + np.sum(s2) ** 2 / n**2) / n**2
    about = (mean - mean.mean()) ** 2 - (1 - 2 / n) * s2 - s2.mean() / n
    spread = max(float(np.sum(s2 * about)), 0.0) / n**2
    of_noise = (1 - 1 / n) ** 2 * np.sum(2 * s2**2 / np.maximum(dof, 1.0)) / n**2
    return float(np.sqrt(2 * trace + 4 * spread + of_noise))


def _along_last(values: Float) -> dict[str, Float]:
    p01, median, p99 = np.percentile(values, [1, 50, 99], axis=-1)
    every = values.mean(-1), values.std(-1), values.min(-1), values.max(-1), median, p01, p99
    return dict(zip(STATISTICS, every, strict=True))


def _row(
    label: str,
    some: _Bins,
    value: Mapping[str, float],
    drawn: Mapping[str, Float],
    calm: Mapping[str, Float | float],
    times: int,
) -> StatisticsRow:
    """A row of statistics whose variance is that of the bins, so many times."""
    variance = times * some.variance
    error = {name: float(drawn[name].std()) for name in STATISTICS}
    added = {name: float(drawn[name].mean() - calm[name]) for name in STATISTICS}
    # noise adds nothing to a mean, and to a variance what is known in closed form
    free = {name: value[name] - added[name] for name in STATISTICS} | {
        "mean": value["mean"],
        "sigma": float(np.sqrt(max(variance, 0.0))),
    }
    # where noise is all there is, what it adds to extremes may carry them past the middle
    free["p01"] = min(free["p01"], free["median"])
    free["min"] = min(free["min"], free["p01"])
    free["p99"] = max(free["p99"], free["median"])
    free["max"] = max(free["max"], free["p99"])
    return StatisticsRow(
        label,
        dict(value),
        error,
        free,
        variance,
        times * some.variance_error,
        some.mean.size,
        some.n_left_out,
    )


def residual_statistics(values: ArrayLike) -> dict[str, float]:
    """Statistics of residuals of stars or of means of bins by name, and their number `n`.

    They are the columns of Table 5-1 of WSDC D-T033, sigma about the mean and over n. NaN (empty
    bins) is left out; InputError when there is no value or one is infinite.
    """
    r = np.asarray(values, float).ravel()
    r = r[~np.isnan(r)]
    if not r.size or np.isinf(r).any():
        raise InputError("there are no residuals, or infinite ones", do="check the fit")
    return {name: float(x) for name, x in _along_last(r).items()} | {"n": r.size}


def pair_statistics(values: Float, *, tolerance: float = 0.0) -> dict[str, float]:
    """Statistics of v_i - v_j over all i and j: the columns of Table 5-3 of WSDC D-T033.

    The n^2 differences contain each value against itself, and are as often the one way as the
    other: mean and median vanish.

    `values` (n,) are finite and not empty, `tolerance` is the allowed error of percentiles, 0 for
    rounding. By name: mean, sigma (about the mean, over n^2), min, max, median, p01, p99;
    percentiles interpolate between neighbours as `numpy.percentile` does.
    """
    a = np.sort(values)
    extent = float(a[-1] - a[0])
    whole, part = divmod((a.size**2 - 1) * 99, 100)
    p99 = _order_statistic(a, whole, tolerance)
    if part:
        p99 += (_order_statistic(a, whole + 1, tolerance) - p99) * part / 100
    return {
        "mean": 0.0,
        "sigma": float(np.hypot(a.std(), a.std())),
        "min": -extent,
        "max": extent,
        "median": 0.0,
        "p01": -p99,
        "p99": p99,
    }


def _order_statistic(a: Float, rank: int, tolerance: float) -> float:
    """Difference with so many others at or below it, by bisection; a is sorted."""
    low, high = a[0] - a[-1], a[-1] - a[0]
    finest = np.spacing(max(high, abs(a[0]), abs(a[-1])))
    if _count(a, low) > rank:
        return float(low)
    while high - low > max(tolerance, 2 * finest):
        middle = (low + high) / 2
        if _count(a, middle) > rank:
            high = middle
        else:
            low = middle
    return float(high)


def _count(a: Float, limit: float) -> int:
    """Number of differences at or below a limit."""
    return int(a.size**2 - np.searchsorted(a, a - limit, side="left").sum())
