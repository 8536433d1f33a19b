"""Tables of statistics of binned residuals with errors, in the layout of WSDC D-T033.

Means of bins contain the mean errors of their stars in addition to what the model lacks.  For every
statistic a row of a table therefore has an error, the scatter that other stars in the same bins
would cause, and a noise-free value, the expectation for infinitely many stars.

Differences between all pairs of bins are never listed: 45 x 45 bins have four million.  Their mean,
sigma and extremes have closed forms.  An order statistic is found by counting: the number of
differences below a limit needs one search in a sorted list per value.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from astropy.table import Table
from numpy.typing import ArrayLike

from bayesdist.diagnose.residuals.binned import BAND_AXES, BinnedSums, BinValues
from bayesdist.errors import DegenerateError, InputError
from bayesdist.utils.arrays import Float

STATISTICS = ("mean", "sigma", "min", "max", "median", "p01", "p99")
_HEADS = dict(
    zip(STATISTICS, ("Mean", "Sigma", "Min", "Max", "Median", "1%-tile", "99%-tile"), strict=True)
)
DRAWS = 300  # realisations of the noise of the bins: errors are accurate to 4 %
_FEWEST_BINS = 3
# tolerance of percentiles of pairs in the draws, as a fraction of their spread
_COARSE = 1e-3


@dataclass(frozen=True, eq=False)
class StatisticsTable:
    """Rows of statistics."""

    title: str
    first: str  # heading of the column of labels
    unit: str  # 'pix' or 'arcsec'
    rows: tuple[StatisticsRow, ...]

    def __getitem__(self, label: str) -> StatisticsRow:
        for row in self.rows:
            if row.label == label:
                return row
        raise KeyError(label)

    def to_table(self, *, errors: bool = False) -> Table:
        """The table in the layout of the report.

        Columns are 'Band/Axis' (or `first`), Mean, Sigma, Min, Max, Median, 1%-tile and 99%-tile;
        with `errors` also 'Mean error', 'Mean noise-free' and so on, 'Sigma noise', 'Bins' and
        'Bins left out'.
        """
        out = Table(meta={"title": self.title, "unit": self.unit})
        out[self.first] = [row.label for row in self.rows]
        parts = [("", "value")]
        if errors:
            parts += [(" error", "error"), (" noise-free", "noise_free")]
        for name, head in _HEADS.items():
            for suffix, part in parts:
                out[head + suffix] = np.array([getattr(row, part)[name] for row in self.rows])
                out[head + suffix].unit = self.unit
                out[head + suffix].format = ".4g"
        if errors:
            out["Sigma noise"] = np.array([row.sigma_noise for row in self.rows])
            out["Sigma noise"].unit = self.unit
            out["Sigma noise"].format = ".4g"
            out["Bins"] = [row.n_bins for row in self.rows]
            out["Bins left out"] = [row.n_left_out for row in self.rows]
        return out


def period_table(
    periods: Mapping[str, BinnedSums],
    *,
    rng: np.random.Generator,
    arcsec_per_pixel: float,
    absorbed: int | Mapping[str, int] = 1,
) -> StatisticsTable:
    """Table C-1: residuals of one band in several periods, in arcsec.

    `periods` are in the order of the table and include the combined one; all residuals refer to the
    combined model.  `rng` is used for the errors.  `absorbed` is the number of coefficients per
    axis that were fitted to the residuals, or a mapping by period if it differs; 1 if the model was
    not fitted to these stars.  Raises DegenerateError if too few bins of a period contain two
    stars.
    """
    rows = tuple(
        bin_row(
            f"{name}/{axis}",
            bins.values(axis).scaled(arcsec_per_pixel),
            absorbed=absorbed if isinstance(absorbed, int) else absorbed[name],
            rng=rng,
        )
        for axis in BAND_AXES[:2]
        for name, bins in periods.items()
    )
    return StatisticsTable("Residuals by period", "Period/Axis", "arcsec", rows)


@dataclass(frozen=True, eq=False)
class StatisticsRow:
    """Statistics of means of bins, or of differences between them."""

    label: str  # as printed in the report: 'W1/X', 'W2-W1/Y', 'W1/radial', '25-Day/X'
    # by the names in `STATISTICS`: statistics of the means without correction, as in the report
    value: Mapping[str, float]
    error: Mapping[str, float]  # standard deviation of `value` due to the noise of the means
    # `value` minus the average contribution of noise to a set of this width and shape. The
    # broadening is removed, but detail finer than the noise, which may affect a median, is not
    # recovered. Min, percentiles, median and max stay in order: they coincide if there is only
    # noise
    noise_free: Mapping[str, float]
    variance: float  # sigma^2 with the noise subtracted; may be negative by chance
    variance_error: float  # its standard deviation
    # n_bins, n_left_out: number of bins that were used, and of those without a standard error
    n_bins: int
    n_left_out: int

    @property
    def sigma_noise(self) -> float:
        """Noise part of sigma, sqrt(sigma^2 - `variance`); 0 if the difference is negative."""
        return float(np.sqrt(max(self.value["sigma"] ** 2 - self.variance, 0.0)))


def bin_row(
    label: str, bins: BinValues, *, absorbed: int, rng: np.random.Generator
) -> StatisticsRow:
    """A row of Tables 5-1, 5-2 and C-1 of WSDC D-T033.

    `absorbed` is the number of coefficients, on this axis, that were fitted to the residuals, at
    least 1: the noise loses that many degrees of freedom.  Raises `DegenerateError` if too few bins
    contain two stars.
    """
    used_bins = _Bins.of(label, bins, absorbed)
    drawn, calm = _along_last(used_bins.draws(rng)), _along_last(used_bins.centre)
    return _row(label, used_bins, used_bins.value, drawn, calm, 1)


def pair_row(
    label: str, bins: BinValues, *, absorbed: int, rng: np.random.Generator
) -> StatisticsRow:
    """A row of Table 5-3 of WSDC D-T033: differences over all pairs of bins.

    For the parameters and errors see `bin_row`.
    """
    used_bins = _Bins.of(label, bins, absorbed)
    coarse = _COARSE * float(np.hypot(used_bins.value["sigma"], used_bins.value["sigma"]))
    rows = [pair_statistics(draw, tolerance=coarse) for draw in used_bins.draws(rng)]
    drawn = {name: np.array([row[name] for row in rows]) for name in STATISTICS}
    calm = pair_statistics(used_bins.centre, tolerance=coarse)
    return _row(label, used_bins, pair_statistics(used_bins.mean), drawn, calm, 2)


@dataclass(frozen=True, eq=False)
class _Bins:
    """Bins that are used, their statistics, and their values without noise."""

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
        # noise that remains after the fit, distributed evenly over the bins
        sem = sem * np.sqrt((n - absorbed) / (n - 1))
        value = {name: float(x) for name, x in _along_last(mean).items()}
        variance = value["sigma"] ** 2 - (1 - 1 / n) * float(np.mean(sem**2))
        error = _variance_error(mean, sem, dof)
        return cls(mean, sem, value, variance, error, good.size - n)

    @property
    def centre(self) -> Float:
        """Values with the distribution of the means without their noise.

        Each deviation from the mean is multiplied by the root of its fraction of true variance.
        With new noise added, the set is as wide as the observed one.
        """
        true = max(self.variance, 0.0)
        total = true + self.sem**2
        share = np.divide(true, total, out=np.ones_like(total), where=total > 0)
        return self.value["mean"] + np.sqrt(share) * (self.mean - self.value["mean"])

    def draws(self, rng: np.random.Generator) -> Float:
        return self.centre + self.sem * rng.standard_normal((DRAWS, self.mean.size))


def _variance_error(mean: Float, sem: Float, dof: Float) -> float:
    """Standard deviation of the noise-corrected variance of bins.

    The variance is the quadratic form b^T A b with A = (1 - 1 1^T / n) / n and b = m + e, where e
    is normal with variances S.  Its variance is 2 tr(A S A S) + 4 m^T A S A m.  The second term is
    estimated from b, with the contribution of noise subtracted.  The error of the noise itself is
    added; its squares have a relative variance of 2 / dof.
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
    values_of_statistics = (
        values.mean(-1),
        values.std(-1),
        values.min(-1),
        values.max(-1),
        median,
        p01,
        p99,
    )
    return dict(zip(STATISTICS, values_of_statistics, strict=True))


def _row(
    label: str,
    some: _Bins,
    value: Mapping[str, float],
    drawn: Mapping[str, Float],
    calm: Mapping[str, Float | float],
    times: int,
) -> StatisticsRow:
    """A row of statistics, with the variance of the bins multiplied by `times`."""
    variance = times * some.variance
    error = {name: float(drawn[name].std()) for name in STATISTICS}
    added = {name: float(drawn[name].mean() - calm[name]) for name in STATISTICS}
    # noise does not change a mean, and its effect on a variance has a closed form
    free = {name: value[name] - added[name] for name in STATISTICS} | {
        "mean": value["mean"],
        "sigma": float(np.sqrt(max(variance, 0.0))),
    }
    # if there is only noise, the correction may move extremes past the median
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
    """Statistics of residuals, of stars or of means of bins, by name, and their number `n`.

    They are the columns of Table 5-1 of WSDC D-T033; sigma is about the mean and divides by n.  NaN
    (empty bins) is ignored.  Raises InputError if there is no value or one is infinite.
    """
    r = np.asarray(values, float).ravel()
    r = r[~np.isnan(r)]
    if not r.size or np.isinf(r).any():
        raise InputError("there are no residuals, or infinite ones", do="check the fit")
    return {name: float(x) for name, x in _along_last(r).items()} | {"n": r.size}


def pair_statistics(values: Float, *, tolerance: float = 0.0) -> dict[str, float]:
    """Statistics of v_i - v_j over all i and j: the columns of Table 5-3 of WSDC D-T033.

    The n^2 differences include each value minus itself, and are symmetric: mean and median are
    zero.  `values` (n,) must be finite and not empty.  `tolerance` is the allowed error of
    percentiles; 0 means rounding precision.  The result has the keys mean, sigma (about the mean,
    over n^2), min, max, median, p01 and p99; percentiles interpolate between neighbours like
    `numpy.percentile`.
    """
    a = np.sort(values)
    extent = float(a[-1] - a[0])
    rank, part = divmod((a.size**2 - 1) * 99, 100)
    p99 = _order_statistic(a, rank, tolerance)
    if part:
        p99 += (_order_statistic(a, rank + 1, tolerance) - p99) * part / 100
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
    """Difference of the given rank, by bisection; `a` is sorted."""
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
    """Number of differences not larger than a limit."""
    return int(a.size**2 - np.searchsorted(a, a - limit, side="left").sum())
