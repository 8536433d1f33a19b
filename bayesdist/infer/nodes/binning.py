"""Look-up table after ACS ISR 2015-06: bins, iterative sigma clipping, smoothing.

ACS ISR 2015-06, section 4.3.1: residuals are averaged in bins of 64 x 64 pixels with iterative
sigma clipping, then each grid point is smoothed with a 5 x 5 quadratic kernel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.nodes.field import checked_stars
from bayesdist.infer.nodes.grid import STEP, NodeGrid
from bayesdist.infer.nodes.smoothing import quadratic_smoother
from bayesdist.model import Chip
from bayesdist.model.lookup import LookupTable

__all__ = ["binned_table"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

PASSES = 20  # of the clipping, at most
OWN_SCATTER = 5  # stars from which on a bin's error is from its own scatter


def binned_table(
    x: ArrayLike,
    y: ArrayLike,
    shift: ArrayLike,
    *,
    chip: Chip,
    order: int | None = None,
    clip: float = 3.0,
    smooth: bool = True,
    filter: str = "",
    step: tuple[float, float] = STEP,
) -> LookupTable:
    """Table of clipped means in bins, smoothed.

    Parameters
    ----------
    x, y : array_like, shape (N,)
        Raw pixels.
    shift : array_like, shape (N, 2)
        Corrections to be added to them, pixels.
    chip : Chip
    order : int, optional
        Subtract the part that a polynomial of this order describes; left in by default, as in the
        report.
    clip : float
        Stars beyond this many standard deviations of their bin's, on either axis, are left out.
    smooth : bool
        True to apply the 5 x 5 kernel: `quadratic_smoother`.
    filter : str
    step : tuple of float
        Size of the bins, pixels.

    Returns
    -------
    LookupTable
        With the standard error of each node, propagated from the errors of the bins' means.  It
        does not include what smoothing removes of the pattern itself.  A node with no star within
        the kernel is zero, and the rms of the others is its error.

    Raises
    ------
    InputError
        For arrays of other shapes, or a clip that is not positive.
    DegenerateError
        When no bin holds two stars.
    """
    if not clip > 0:
        raise InputError(f"stars are clipped at {clip} sigma", do="give a positive number")
    ones = np.ones_like(np.asarray(shift, float))
    px, py, r, _, _ = checked_stars(x, y, shift, ones, None, chip)
    grid = NodeGrid(chip, 1 if order is None else order, step)
    ny, nx = grid.shape
    i = np.clip(((px - 0.5) // step[0]).astype(np.int64), 0, nx - 1)
    j = np.clip(((py - 0.5) // step[1]).astype(np.int64), 0, ny - 1)
    bins = j * nx + i

    kept = _clipped(bins, r, grid.n_nodes, clip)
    count, mean, scatter = _moments(bins[kept], r[kept], grid.n_nodes)
    several = count > 1
    if not several.any():
        raise DegenerateError(
            "no bin holds two stars",
            where=f"look-up table of chip {chip.number}",
            do="give more matches or larger bins",
        )
    freedom = (count[several] - 1)[:, None]
    pooled = (scatter[several] ** 2 * freedom).sum(axis=0) / freedom.sum()
    square = np.where((count >= OWN_SCATTER)[:, None], scatter**2, pooled)
    filled = count > 0
    variance = np.where(filled[:, None], square / np.maximum(count, 1)[:, None], 0.0)

    if smooth:
        H = quadratic_smoother(filled.reshape(ny, nx))
        mean, variance = H @ mean, H.power(2) @ variance
        filled = np.diff(H.indptr) > 0
    if order is not None:
        mean = grid.without_polynomials(mean)
    sigma = np.sqrt(variance)
    sigma[~filled] = np.sqrt((mean[filled] ** 2).mean(axis=0))
    return grid.table(mean.T, sigma.T, filter=filter)


def _clipped(bins: Int, r: Float, n: int, clip: float) -> NDArray[np.bool_]:
    """Boolean mask (N,) of the stars left when clipping changes nothing any more."""
    centre, scale = _robust(bins, r, n)
    kept: NDArray[np.bool_] = np.ones(len(r), bool)
    for _ in range(PASSES):
        within = np.asarray((np.abs(r - centre[bins]) <= clip * scale[bins]).all(axis=1))
        if np.array_equal(within, kept):
            break
        kept = within
        _, centre, scale = _moments(bins[kept], r[kept], n)
    return kept


def _robust(bins: Int, r: Float, n: int) -> tuple[Float, Float]:
    """Median and scaled median absolute deviation (n, 2), from which the clipping starts."""
    centre, scale = np.zeros((n, 2)), np.zeros((n, 2))
    for a in (0, 1):
        centre[:, a] = _medians(bins, r[:, a], n)
        scale[:, a] = 1.4826 * _medians(bins, np.abs(r[:, a] - centre[bins, a]), n)
    return centre, scale


def _medians(bins: Int, values: Float, n: int) -> Float:
    ordered = values[np.lexsort((values, bins))]
    count = np.bincount(bins, minlength=n)
    start = np.cumsum(count) - count
    out = np.zeros(n)
    has = count > 0
    low = (start + (count - 1) // 2)[has]
    high = (start + count // 2)[has]
    out[has] = (ordered[low] + ordered[high]) / 2
    return out


def _moments(bins: Int, r: Float, n: int) -> tuple[Int, Float, Float]:
    """Number (n,), mean and standard deviation (n, 2) of stars in a bin; zero where undefined."""
    count = np.bincount(bins, minlength=n)
    mean, square = np.zeros((n, 2)), np.zeros((n, 2))
    for a in (0, 1):
        mean[:, a] = np.bincount(bins, r[:, a], n) / np.maximum(count, 1)
        square[:, a] = np.bincount(bins, (r[:, a] - mean[bins, a]) ** 2, n)
    return count, mean, np.sqrt(square / np.maximum(count - 1, 1)[:, None])
