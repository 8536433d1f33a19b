"""Look-up table modelled as a Gaussian random field that the stars sample bilinearly."""

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

STEADY = 1e-5  # relative change of the variance at which the jitter counts as converged
MAX_ITERATIONS = 6
SEARCHES = ("chip", "tiles", "none")


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
    """Convert the columns of the stars to float64 arrays and check them.

    Raises InputError if shapes are inconsistent, there are no stars, values are not finite,
    variances are not positive, or weights are outside 0 to 1.
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
                f"'{name}' has shape {array.shape} and {wanted} is expected",
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
