"""Look-up table of one filter: as a Gaussian random field, or as smoothed means of bins.

`field_table` computes the posterior of a random field, which the stars sample bilinearly.

`binned_table` follows ISR 2015-06, section 4.3.1: residuals are averaged in bins of 64 x 64 pixels
with iterative sigma clipping.  The grid is then smoothed with a 5 x 5 quadratic kernel: each node
gets the value of a quadratic surface fitted with equal weights to the 25 values around it (Anderson
and King 2000, PASP 112, 1360).  Away from edges and empty bins this equals their fixed kernel, with
27/175 at the centre.  Near an edge or an empty bin the surface is fitted to the available values.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike
from scipy import ndimage

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.kernel.blocks import at_once
from bayesdist.infer.nodes.grid import BLOCK, STEP, NodeGrid, NodeSums, node_sums
from bayesdist.infer.nodes.posterior import (
    SMOOTHNESS,
    AxisField,
    Evidence,
    TablePosterior,
    fitted_field,
)
from bayesdist.infer.nodes.residuals import jitter_variance
from bayesdist.model import Chip
from bayesdist.model.lookup import LookupTable
from bayesdist.utils.arrays import Bool, Float, Int

STEADY = 1e-5  # relative change of the variance at which the jitter counts as converged
MAX_ITERATIONS = 6
SEARCHES = ("chip", "tiles", "none")

PASSES = 20  # maximum number of clipping iterations
OWN_SCATTER = 5  # with fewer stars, the error of a bin is computed from the pooled scatter
HALF_WIDTH = 2  # nodes: the kernel is 5 x 5
# values per coefficient of the surface: the 3 x 3 values at a corner determine a quadratic
ENOUGH = 1.5


# a second thread does not speed up a factorisation of this size; the two axes run in parallel
@one_thread
def field_table(
    x: ArrayLike,
    y: ArrayLike,
    shift: ArrayLike,
    variance: ArrayLike,
    *,
    chip: Chip,
    order: int,
    weight: ArrayLike | None = None,
    filter: str = "",
    step: tuple[float, float] = STEP,
    smoothness: Sequence[float] = SMOOTHNESS,
    earlier: TablePosterior | None = None,
    search: str = "chip",
) -> TablePosterior:
    """Compute the posterior of a look-up table from the residuals of one chip.

        shift = W d + polynomial + noise,  noise variance = quoted variance + jitter^2

    W are bilinear weights.  The node values d are a Matern field without its polynomial part.  The
    polynomial is integrated out under a flat prior.  The result is therefore the table of the joint
    solution of table and polynomial, whichever polynomial was used for the residuals.  Amplitude,
    correlation length and smoothness of the field maximise the marginal likelihood, separately for
    each axis, since column defects appear in x only.

    Parameters
    ----------
    x, y : array_like, shape (N,)
        Raw pixel coordinates.
    shift : array_like, shape (N, 2)
        Corrections to be added to x and y, in pixels; see `pixel_shifts`.
    variance : array_like, shape (N, 2)
        Variances of the shifts, in square pixels.
    chip : Chip
    order : int
        Order of the polynomial that is fitted together with the table.
    weight : array_like, shape (N,), optional
        Probability that each star is a true match; 1 by default.
    filter : str
        Filter of the table; '' for the detector's table.
    step : tuple of float
        Distance of the nodes along x and y, in pixels.
    smoothness : sequence of float
        Values of the Matern smoothness to try; a subset of 0.5, 1.5, 2.5.
    earlier : TablePosterior, optional
        Table from an earlier iteration, of nearly the same stars on the same grid. It provides the
        initial jitter and, with ``search='none'``, the hyperparameters.
    search : str
        How the hyperparameters are optimised. 'tiles': on independent tiles of the chip, which is
        fast and a good approximation; 'chip': on tiles, then on the entire chip; 'none': those of
        the earlier table are kept.

    Returns
    -------
    TablePosterior

    Raises
    ------
    InputError
        If arrays have inconsistent shapes or invalid values, `smoothness` or `search` is unknown,
        or the earlier table has another grid or is missing with ``search='none'``.
    DegenerateError
        If the stars do not determine the polynomial.
    """
    bad = [nu for nu in smoothness if nu not in SMOOTHNESS]
    if bad or not smoothness:
        raise InputError(
            f"there is no field of smoothness {bad}" if bad else "no smoothness is given",
            do=f"choose among {', '.join(map(str, SMOOTHNESS))}",
        )
    if search not in SEARCHES:
        raise InputError(f"there is no search {search!r}", do=f"choose among {', '.join(SEARCHES)}")
    if search == "none" and earlier is None:
        raise InputError("there are no hyperparameters to hold", do="give the earlier table")
    px, py, r, var, w = checked_stars(x, y, shift, variance, weight, chip)
    grid = NodeGrid(chip, order, step)
    if earlier is not None:
        if earlier.grid != grid:
            raise InputError(
                f"the earlier table of chip {earlier.grid.chip.number} has another grid",
                do="give one of the same chip, order and step",
            )
        grid = earlier.grid  # its cached properties are reused

    def sums_at(j2: float) -> tuple[NodeSums, NodeSums]:
        return node_sums(grid, px, py, r, w[:, None] / (var + j2))

    def jitter_at(
        sums: Sequence[NodeSums], nodes: Sequence[Float], n: float
    ) -> tuple[float, float]:
        return jitter_variance(_residual(grid, px, py, r, sums, nodes), var, w, n)

    def searched(evidence: Evidence) -> AxisField:
        return AxisField.of(evidence, fitted_field(evidence, smoothness, thorough=search == "chip"))

    j2 = 0.0 if earlier is None else earlier.jitter**2
    sums = sums_at(j2)
    if search == "none" and earlier is not None:
        axes = at_once(AxisField.following, earlier.axes, sums)
    else:
        evidences = [Evidence(grid, s) for s in sums]
        if earlier is None:
            # no hyperparameters yet: estimate the jitter from unsmoothed node values
            nodes = at_once(lambda evidence: evidence.rough, evidences)
            n = float(sum(np.count_nonzero(s.nodes.diagonal()) for s in sums))
        else:
            nodes = [axis.mean for axis in earlier.axes]
            n = sum(axis.n_effective for axis in earlier.axes)
        before, (j2, _) = j2, jitter_at(sums, nodes, n)
        if j2 != before:
            sums = sums_at(j2)
            evidences = [Evidence(grid, s) for s in sums]
        axes = at_once(searched, evidences)
    typical = float(np.median(var))
    for _ in range(MAX_ITERATIONS):
        n = sum(axis.n_effective for axis in axes)
        new, error = jitter_at(sums, [axis.mean for axis in axes], n)
        if abs(new - j2) < 0.3 * error + STEADY * (typical + j2):
            break
        j2, sums = new, sums_at(new)
        axes = at_once(AxisField.at_same_prior, axes, sums)
    # the standard error of a large jitter; for a jitter of zero an upper limit
    jitter = float(np.sqrt(j2))
    spread = float(np.sqrt(j2 + error)) - jitter
    return TablePosterior(grid, (axes[0], axes[1]), filter, jitter, spread, float(w.sum()))


def checked_stars(
    x: ArrayLike,
    y: ArrayLike,
    shift: ArrayLike,
    variance: ArrayLike,
    weight: ArrayLike | None,
    chip: Chip,
) -> tuple[Float, Float, Float, Float, Float]:
    """Convert the columns of the N stars to float64 arrays and check them.

    `x`, `y` and `weight` have shape (N,), and `shift` and `variance` (N, 2); the weight is 1 by
    default. Raises InputError if shapes are inconsistent, there are no stars, values are not
    finite, variances are not positive, or weights are outside 0 to 1.
    """
    location = f"look-up table of chip {chip.number}"
    px = np.atleast_1d(np.asarray(x, float))
    n = len(px)
    columns = {
        "y": np.atleast_1d(np.asarray(y, float)),
        "shift": np.asarray(shift, float),
        "variance": np.asarray(variance, float),
        "weight": np.ones(n) if weight is None else np.asarray(weight, float),
    }
    if n == 0:
        raise InputError("there are no stars", where=location, do="give matches on this chip")
    for name, array in columns.items():
        wanted = (n, 2) if name in ("shift", "variance") else (n,)
        if array.shape != wanted:
            raise InputError(
                f"'{name}' has shape {array.shape}, but {wanted} is expected",
                where=location,
                do="give one row for each star",
            )
    for name, array in {"x": px, **columns}.items():
        good = np.isfinite(array)
        if name == "variance":
            good &= array > 0
        if name == "weight":
            good &= (array >= 0) & (array <= 1)
        if not good.all():
            k = tuple(np.argwhere(~good)[0])
            raise InputError(
                f"'{name}' is {array[k]:g}",
                where=f"{location}, star {k[0] + 1}",
                do="give finite values, positive variances and weights from 0 to 1",
            )
    return px, columns["y"], columns["shift"], columns["variance"], columns["weight"]


def _residual(
    grid: NodeGrid,
    x: Float,
    y: Float,
    shift: Float,
    sums: Sequence[NodeSums],
    nodes: Sequence[Float],
) -> Float:
    """Shifts (N, 2) minus the table with these node values and the corresponding polynomial."""
    values = np.stack(nodes, axis=1)
    polynomial = np.stack([s.polynomial_of(d) for s, d in zip(sums, nodes, strict=True)], axis=1)
    out = np.empty_like(shift)
    for start in range(0, len(x), BLOCK):
        rows = slice(start, start + BLOCK)
        fitted = grid.interpolation(x[rows], y[rows]) @ values
        fitted += grid.basis.evaluate(x[rows], y[rows]) @ polynomial
        out[rows] = shift[rows] - fitted
    return out


# -- look-up table: bins, iterative sigma clipping, smoothing --------------------------------------


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
