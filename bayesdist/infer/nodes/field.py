"""Look-up table as a Gaussian random field, measured by every star through bilinear weights."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import InputError
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.kernel.blocks import at_once
from bayesdist.infer.nodes.grid import STEP, NodeGrid
from bayesdist.infer.nodes.hyperparameters import (
    SMOOTHNESS,
    Evidence,
    fitted_field,
)
from bayesdist.infer.nodes.mixture import jitter_variance
from bayesdist.infer.nodes.posterior import AxisField, TablePosterior
from bayesdist.infer.nodes.sums import BLOCK, NodeSums, node_sums
from bayesdist.model import Chip
from bayesdist.utils.arrays import Float

STEADY = 1e-5  # change of the stars' typical variance that is small against any error of the jitter
MAX_ITERATIONS = 6
SEARCHES = ("chip", "tiles", "none")


# a factorisation of this size is no faster on two threads: the two axes have one each
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
    """Posterior of a table from the residuals of one chip.

        shift = W d + polynomial + noise,  noise variance = quoted variance + jitter^2

    The node values d are a Matern field without its polynomial part.  The polynomial is integrated
    out under a flat prior, so that a table from the residuals of any earlier polynomial fit is the
    table of the joint solution.  Amplitude, length and smoothness maximise the marginal likelihood,
    separately for each axis: a defect of columns is seen in x alone, and a common value would save
    no time.  The two are made at the same time where there are threads.

    Parameters
    ----------
    x, y : array_like, shape (N,)
        Raw pixels.
    shift : array_like, shape (N, 2)
        Corrections to be added to them, pixels: see `pixel_shifts`.
    variance : array_like, shape (N, 2)
        Square of its error, square pixels.
    chip : Chip
    order : int
        Of the polynomial that goes with the table.
    weight : array_like, shape (N,), optional
        Probability of being a true match.
    filter : str
        The table's filter; '' for the detector's own.
    step : tuple of float
        Pixels between nodes.
    smoothness : sequence of float
        Matern smoothness to choose from.
    earlier : TablePosterior, optional
        Table of nearly the same stars on the same grid from an earlier iteration: it gives the
        first jitter, and the hyperparameters where they are not searched.
    search : str
        Of the hyperparameters.  'chip': all that are likely on independent tiles are tried on the
        whole chip; 'tiles': those of the tiles are taken, which are near; 'none': the earlier
        table's are held.

    Returns
    -------
    TablePosterior

    Raises
    ------
    InputError
        For arrays of other shapes, values that are not finite, an unknown smoothness or search, no
        search and no earlier table, or an earlier table on another grid.
    DegenerateError
        When the stars do not determine the polynomial.
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
        grid = earlier.grid  # with what is known of it

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
            # a first value without any smoothing: there are no hyperparameters yet
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
    # standard error of j where j is large; where it is zero, its possible size
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
    """Stars as arrays of float64.

    InputError for other shapes, no stars, values that are not finite, variances that are not
    positive, or weights outside 0..1.
    """
    where = f"look-up table of chip {chip.number}"
    px = np.atleast_1d(np.asarray(x, float))
    n = len(px)
    given = {
        "y": np.atleast_1d(np.asarray(y, float)),
        "shift": np.asarray(shift, float),
        "variance": np.asarray(variance, float),
        "weight": np.ones(n) if weight is None else np.asarray(weight, float),
    }
    if n == 0:
        raise InputError("there are no stars", where=where, do="give matches on this chip")
    for name, array in given.items():
        wanted = (n, 2) if name in ("shift", "variance") else (n,)
        if array.shape != wanted:
            raise InputError(
                f"'{name}' has shape {array.shape} and {wanted} is expected",
                where=where,
                do="give one row for each star",
            )
    for name, array in {"x": px, **given}.items():
        good = np.isfinite(array)
        if name == "variance":
            good &= array > 0
        if name == "weight":
            good &= (array >= 0) & (array <= 1)
        if not good.all():
            k = tuple(np.argwhere(~good)[0])
            raise InputError(
                f"'{name}' is {array[k]:g}",
                where=f"{where}, star {k[0] + 1}",
                do="give finite values, positive variances and weights from 0 to 1",
            )
    return px, given["y"], given["shift"], given["variance"], given["weight"]


def _residual(
    grid: NodeGrid,
    x: Float,
    y: Float,
    shift: Float,
    sums: Sequence[NodeSums],
    nodes: Sequence[Float],
) -> Float:
    """Shifts minus node values of both axes and the polynomials that go with them."""
    values = np.stack(nodes, axis=1)
    polynomial = np.stack([s.polynomial_of(d) for s, d in zip(sums, nodes, strict=True)], axis=1)
    out = np.empty_like(shift)
    for start in range(0, len(x), BLOCK):
        rows = slice(start, start + BLOCK)
        fitted = grid.interpolation(x[rows], y[rows]) @ values
        fitted += grid.basis.evaluate(x[rows], y[rows]) @ polynomial
        out[rows] = shift[rows] - fitted
    return out
