"""What is left after the fit: residuals averaged over the detector, and their statistics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.errors import InputError

__all__ = ["BinnedResiduals", "binned_residuals", "residual_statistics"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class BinnedResiduals:
    """Mean residuals on a grid of equal bins that cover the detector.

    Parameters
    ----------
    x : ndarray, shape (nx,)
    y : ndarray, shape (ny,)
        Centres of the bins, FITS 1-based pixels.
    mean_u, mean_v : ndarray, shape (ny, nx)
        Weighted means; NaN in an empty bin.
    count : ndarray of int, shape (ny, nx)
        Stars of positive weight.
    sem_u, sem_v : ndarray, shape (ny, nx)
        Standard errors of the means from the scatter inside the bin; NaN below two stars.
    n_outside : int
        Stars of positive weight that lie on no pixel of the detector and went into no bin.
    """

    x: Float
    y: Float
    mean_u: Float
    mean_v: Float
    count: Int
    sem_u: Float
    sem_v: Float
    n_outside: int = 0


def binned_residuals(
    x: ArrayLike,
    y: ArrayLike,
    ru: ArrayLike,
    rv: ArrayLike,
    *,
    bins: int | tuple[int, int],
    size: tuple[float, float],
    weights: ArrayLike | None = None,
) -> BinnedResiduals:
    """Residuals averaged in bins of the detector.

    Parameters
    ----------
    x, y : array_like, shape (N,)
        FITS 1-based pixels.
    ru, rv : array_like, shape (N,)
        Residuals, data minus model.
    bins : int or tuple of int
        Number of bins on x and on y (WSDC D-T033 uses 31 on each).
    size : tuple of float
        Columns and rows of the detector; the bins run from 0.5 to size + 0.5.
    weights : array_like, shape (N,), optional
        Not negative; a star of weight 0 (one that was rejected, say) is left out.

    Returns
    -------
    BinnedResiduals

    Raises
    ------
    InputError
        For lengths that differ, values that are not finite where the weight is positive, negative
        weights, or a bad number of bins.
    """
    nx, ny = (bins, bins) if isinstance(bins, int | np.integer) else bins
    if min(nx, ny) < 1 or int(nx) != nx or int(ny) != ny:
        raise InputError(f"the number of bins is {bins}", do="give whole numbers of at least 1")
    x, y, ru, rv = (np.asarray(a, float) for a in (x, y, ru, rv))
    w = np.ones_like(x) if weights is None else np.asarray(weights, float)
    if not x.ndim == 1 or not x.shape == y.shape == ru.shape == rv.shape == w.shape:
        raise InputError("positions, residuals and weights differ in length")
    if not (w >= 0).all() or not np.isfinite(w).all():
        raise InputError("weights must be finite and not negative", where="weights")
    used = w > 0
    if not all(np.isfinite(a[used]).all() for a in (x, y, ru, rv)):
        raise InputError("a position or residual is not finite", do="give that star the weight 0")

    edges_x = np.linspace(0.5, size[0] + 0.5, nx + 1)
    edges_y = np.linspace(0.5, size[1] + 0.5, ny + 1)
    inside = used.copy()
    for values, edges in ((x, edges_x), (y, edges_y)):
        inside[used] &= (values[used] >= edges[0]) & (values[used] <= edges[-1])
    index = _bin(y[inside], edges_y) * nx + _bin(x[inside], edges_x)
    w, n = w[inside], nx * ny
    count = np.bincount(index, minlength=n)
    total = np.bincount(index, w, minlength=n)
    means, sems = [], []
    for r in (ru[inside], rv[inside]):
        mean = _ratio(np.bincount(index, w * r, minlength=n), total)
        spread = np.bincount(index, (w * (r - mean[index])) ** 2, minlength=n)
        # with equal weights this is the sample variance over n
        variance = _ratio(spread, total**2) * _ratio(count.astype(float), count - 1.0)
        means.append(mean.reshape(ny, nx))
        sems.append(np.sqrt(variance).reshape(ny, nx))
    return BinnedResiduals(
        x=(edges_x[:-1] + edges_x[1:]) / 2,
        y=(edges_y[:-1] + edges_y[1:]) / 2,
        mean_u=means[0],
        mean_v=means[1],
        count=count.astype(np.int64).reshape(ny, nx),
        sem_u=sems[0],
        sem_v=sems[1],
        n_outside=int(used.sum() - inside.sum()),
    )


def _bin(values: Float, edges: Float) -> Int:
    """Bin of each value; the last edge belongs to the last bin."""
    return np.minimum(np.searchsorted(edges, values, side="right") - 1, edges.size - 2)


def _ratio(a: Float, b: Float) -> Float:
    return np.divide(a, b, out=np.full(a.shape, np.nan), where=b > 0)


def residual_statistics(values: ArrayLike) -> dict[str, float]:
    """Statistics of residuals: the columns of Table 5-1 of WSDC D-T033.

    Parameters
    ----------
    values : array_like
        Residuals of stars or means of bins, any shape; NaN (empty bins) is left out.

    Returns
    -------
    dict
        mean, sigma (about the mean, over n), min, max, median, p01, p99 (percentiles), and n, the
        number of values.

    Raises
    ------
    InputError
        When there is no value or one is infinite.
    """
    r = np.asarray(values, float).ravel()
    r = r[~np.isnan(r)]
    if not r.size or np.isinf(r).any():
        raise InputError("there are no residuals, or infinite ones", do="check the fit")
    p01, median, p99 = np.percentile(r, [1, 50, 99])
    return {
        "mean": float(r.mean()),
        "sigma": float(r.std()),
        "min": float(r.min()),
        "max": float(r.max()),
        "median": float(median),
        "p01": float(p01),
        "p99": float(p99),
        "n": int(r.size),
    }
