"""Look-up table after ACS ISR 2015-06: bins, iterative sigma clipping, smoothing.

ACS ISR 2015-06, section 4.3.1: residuals are averaged in bins of 64 x 64 pixels with iterative
sigma clipping.  The grid is then smoothed with a 5 x 5 quadratic kernel: each node gets the value
of a quadratic surface fitted with equal weights to the 25 values around it (Anderson and King 2000,
PASP 112, 1360).  Away from edges and empty bins this equals their fixed kernel, with 27/175 at the
centre.  Near an edge or an empty bin the surface is fitted to the available values.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike
from scipy import ndimage

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.nodes.field import checked_stars
from bayesdist.infer.nodes.grid import STEP, NodeGrid
from bayesdist.model import Chip
from bayesdist.model.lookup import LookupTable
from bayesdist.utils.arrays import Bool, Float, Int

PASSES = 20  # maximum number of clipping iterations
OWN_SCATTER = 5  # with fewer stars, the error of a bin is computed from the pooled scatter
HALF_WIDTH = 2  # nodes: the kernel is 5 x 5
# values per coefficient of the surface: the 3 x 3 values at a corner determine a quadratic
ENOUGH = 1.5


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
    """Make a look-up table from clipped mean shifts in bins, smoothed.

    Parameters
    ----------
    x, y : array_like, shape (N,)
        Raw pixel coordinates.
    shift : array_like, shape (N, 2)
        Corrections to be added to x and y, in pixels.
    chip : Chip
    order : int, optional
        Remove the polynomial of this order from the node values. By default it is not removed, as
        in the ISR.
    clip : float
        Stars that deviate from the mean of their bin by more than this many standard deviations,
        on either axis, are rejected.
    smooth : bool
        True to smooth the nodes with the 5 x 5 kernel.
    filter : str
        Filter of the table; '' for the detector's table.
    step : tuple of float
        Size of the bins along x and y, in pixels.

    Returns
    -------
    LookupTable
        Node values with standard errors, propagated from the errors of the bin means.  They do not
        include the bias of smoothing.  A node without stars within its kernel gets the value zero,
        with the rms of the other nodes as its error.

    Raises
    ------
    InputError
        If arrays have inconsistent shapes or invalid values, or `clip` is not positive.
    DegenerateError
        If no bin contains two stars.
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

    inlier = _clipped(bins, r, grid.n_nodes, clip)
    count, mean, scatter = _moments(bins[inlier], r[inlier], grid.n_nodes)
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


def _clipped(bins: Int, r: Float, n: int, clip: float) -> Bool:
    """Boolean mask (N,) that is True for the stars that survive iterative sigma clipping."""
    centre, scale = _robust(bins, r, n)
    inlier: Bool = np.ones(len(r), bool)
    for _ in range(PASSES):
        within = np.asarray((np.abs(r - centre[bins]) <= clip * scale[bins]).all(axis=1))
        if np.array_equal(within, inlier):
            break
        inlier = within
        _, centre, scale = _moments(bins[inlier], r[inlier], n)
    return inlier


def _robust(bins: Int, r: Float, n: int) -> tuple[Float, Float]:
    """Median and scaled median absolute deviation (n, 2) per bin, to start the clipping."""
    centre, scale = np.zeros((n, 2)), np.zeros((n, 2))
    filled = np.unique(bins)
    for a in (0, 1):
        centre[filled, a] = ndimage.median(r[:, a], bins, filled)
        off = np.abs(r[:, a] - centre[bins, a])
        scale[filled, a] = 1.4826 * ndimage.median(off, bins, filled)
    return centre, scale


def _moments(bins: Int, r: Float, n: int) -> tuple[Int, Float, Float]:
    """Number (n,), mean and standard deviation (n, 2) of the stars per bin; 0 if undefined."""
    count = np.bincount(bins, minlength=n)
    mean, square = np.zeros((n, 2)), np.zeros((n, 2))
    for a in (0, 1):
        mean[:, a] = np.bincount(bins, r[:, a], n) / np.maximum(count, 1)
        square[:, a] = np.bincount(bins, (r[:, a] - mean[bins, a]) ** 2, n)
    return count, mean, np.sqrt(square / np.maximum(count - 1, 1)[:, None])


def quadratic_smoother(filled: Bool) -> scipy.sparse.csr_array:
    """Sparse matrix (n_nodes, n_nodes) that smooths node values with the quadratic kernel.

    Parameters
    ----------
    filled : ndarray of bool, shape (ny, nx)
        True for nodes with a value.

    Returns
    -------
    scipy.sparse.csr_array
        Columns of empty nodes are zero. With too few values in its window, a node gets the value
        of a fitted plane, or their mean. The row of a node without values in its window is zero.
    """
    ny, nx = filled.shape
    rows, columns, entries = [], [], []
    for j in range(ny):
        for i in range(nx):
            low_j, low_i = max(j - HALF_WIDTH, 0), max(i - HALF_WIDTH, 0)
            window = filled[low_j : j + HALF_WIDTH + 1, low_i : i + HALF_WIDTH + 1]
            dj, di = np.nonzero(window)
            if not len(dj):
                continue
            dj, di = dj + low_j - j, di + low_i - i
            kernel = _kernel(tuple(di.tolist()), tuple(dj.tolist()))
            rows.append(np.full(len(dj), j * nx + i))
            columns.append((dj + j) * nx + di + i)
            entries.append(kernel)
    shape = (ny * nx, ny * nx)
    if not rows:
        return scipy.sparse.csr_array(shape)
    indices = (np.concatenate(rows), np.concatenate(columns))
    return scipy.sparse.coo_array((np.concatenate(entries), indices), shape).tocsr()


@lru_cache(maxsize=4096)
def _kernel(dx: tuple[int, ...], dy: tuple[int, ...]) -> Float:
    """Weights (m,) of values at offsets dx, dy (m,) in the fitted surface at offset zero."""
    x, y = np.array(dx, float), np.array(dy, float)
    quadratic = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    for n in (6, 3, 1):
        design = quadratic[:, :n]
        enough = len(x) >= ENOUGH * n or n == 1
        if enough and np.linalg.matrix_rank(design) == n:
            break
    weights: Float = np.linalg.pinv(design)[0]
    return weights
