"""Errors of look-up tables between their nodes, from neighbouring stars in different exposures.

A table is bilinear between nodes, and the distortion is not.  The error is measured rather than
derived from smoothness.  Two stars at the same position in different exposures share the error of
the table and nothing else: the mean product of their residuals is the mean square of that error.
The table and its polynomial were fitted to the same residuals and have absorbed part of them.  That
part equals their posterior variance V, because a fit leaves residuals with the covariance N - V,
where N is that of the data.  The mean square is therefore

    S = <r_i r_j> + V          i, j: different stars, different exposures, same cell

The squares between nodes are divided evenly into 4 x 4 and 8 x 8 cells.  Averaging over a cell
reduces the mean square of a smooth error in proportion to the cell's area, so that both divisions
together determine the mean square at a point.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.special import log_ndtr

from bayesdist.data import Matches
from bayesdist.diagnose.statistics import squares_over, sums_over
from bayesdist.errors import DegenerateError
from bayesdist.infer import LinearFit
from bayesdist.infer.nodes import (
    ResidualMixture,
    TablePosterior,
    corrected_matches,
    fit_mixture,
    held_sigma,
    pixel_shifts,
)
from bayesdist.model import Chip, LookupTable
from bayesdist.utils.arrays import Bool, Float, Int

FAR = 6.0  # residual beyond which a match is excluded, in standard deviations
log = logging.getLogger("bayesdist")
FINE, COARSE = 8, 4  # number of cells along a side of the squares between nodes
AREA_RATIO = (FINE / COARSE) ** 2  # ratio of the areas of the cells
MIN_PAIRS = 30  # pairs of stars
MAX_ITERATIONS = 3  # of weights that depend on the result
CELLS_SAMPLED = 1500  # number of cells in which the variance of the fit is evaluated


def measured_between(
    pairs: Matches,
    fit: LinearFit,
    tables: Sequence[LookupTable],
    *,
    filter: str,
    posteriors: Sequence[TablePosterior] = (),
    mixture: ResidualMixture | None = None,
    fitted: bool = True,
) -> tuple[BetweenNodes, ...]:
    """Distortion that tables lack between their nodes, for each chip on which it can be measured.

    Parameters
    ----------
    pairs : Matches
        Pairs at raw pixels, with errors.
    fit : LinearFit
        The polynomial that belongs to the tables.
    tables : sequence of LookupTable
        Look-up tables of all chips and filters.
    filter : str
        Filter of the pairs.
    posteriors : sequence of TablePosterior
        Posteriors of the tables that were fitted to these pairs.
    mixture : ResidualMixture, optional
        Mixture model of the pairs; fitted to their residuals by default.
    fitted : bool
        True if the tables were fitted to these pairs.  Otherwise the errors of the tables are
        independent of them.

    Returns
    -------
    tuple of BetweenNodes
        One item per chip; empty if the pairs have no star codes.
    """
    if pairs.star is None:
        return ()
    numbers = pairs.chip_number
    shifts = pixel_shifts(fit, corrected_matches(tables, pairs))
    mixture = mixture or fit_mixture(shifts.shift, shifts.variance)
    jitter = np.full(len(pairs), mixture.jitter)
    for table_posterior in posteriors:
        jitter[numbers == table_posterior.table.chip] = table_posterior.jitter
    total = shifts.variance + jitter[:, None] ** 2
    # A false match is independent of its neighbours. Only those far off are excluded, so that stars
    # displaced by the pattern itself are kept.
    near = (shifts.shift**2 / total).sum(axis=1, keepdims=True) < FAR**2
    precision = near / total
    out = []
    for chip in fit.model.chips:
        chip_tables = [t for t in tables if t.chip == chip.number and t.filter in ("", filter)]
        rows = np.flatnonzero(numbers == chip.number)
        if not chip_tables or not len(rows):
            continue
        posterior = next((p for p in posteriors if p.table.chip == chip.number), None)
        try:
            result = between_nodes(
                pairs.x[rows],
                pairs.y[rows],
                shifts.shift[rows],
                precision[rows],
                star=pairs.star[rows],
                exposure=pairs.exposure[rows],
                chip=chip,
                step=chip_tables[-1].step,
                taken=_taken(posterior, chip_tables, chip, fitted),
            )
        except DegenerateError as error:
            log.info("fit: %s", error)
            continue
        out.append(result)
    return tuple(out)


def _taken(
    posterior: TablePosterior | None, tables: Sequence[LookupTable], chip: Chip, fitted: bool
) -> Callable[[Float, Float], Float]:
    """Function for the variance (n, 2) that tables and polynomial absorb at pixels (n,)."""
    if posterior is not None:
        return partial(_of_posterior, posterior, chip)

    def of_nodes(x: Float, y: Float) -> Float:
        variance = held_sigma(tables[-1:], x, y, chip=chip.number) ** 2
        return variance if fitted else -variance

    return of_nodes


def _of_posterior(posterior: TablePosterior, chip: Chip, x: Float, y: Float) -> Float:
    """Variance (n, 2) of a posterior, including that of its polynomial."""
    out = posterior.position_sigma(x, y, refitted=True) ** 2
    phi = posterior.grid.basis.evaluate(*_on(chip, x, y))
    for a, axis in enumerate(posterior.axes):
        out[:, a] += ((phi @ axis.sums.polynomial_root) ** 2).sum(axis=1)
    return out


def _on(chip: Chip, x: Float, y: Float) -> tuple[Float, Float]:
    """Nearest pixels on the chip: centres of cells at its edge may be outside."""
    nx, ny = chip.size
    return np.clip(x, 0.5, nx + 0.5), np.clip(y, 0.5, ny + 0.5)


@dataclass(frozen=True, eq=False)
class BetweenNodes:
    """Mean square error of a table between its nodes, on one chip."""

    chip: int  # chip number
    # square, error (2,): along x and y, square pixels, and standard deviations; a square may be
    # negative
    square: Float
    error: Float
    n_pairs: int  # number of pairs of stars

    @property
    def left(self) -> MeanSquare:
        """Mean squares, given that they are not negative."""
        return MeanSquare(self.square, self.error)


def between_nodes(
    x: Float,
    y: Float,
    residual: Float,
    precision: Float,
    *,
    star: Int,
    exposure: Int,
    chip: Chip,
    step: tuple[float, float],
    taken: Callable[[Float, Float], Float],
) -> BetweenNodes:
    """Mean square error of a table between its nodes, on one chip.

    Parameters
    ----------
    x, y : ndarray, shape (N,)
        Raw pixels.
    residual : ndarray, shape (N, 2)
        Residuals from table and polynomial, pixels.
    precision : ndarray, shape (N, 2)
        Inverse variances used in the fit; 0 for stars that were not used.
    star, exposure : ndarray of int, shape (N,)
        Codes of the stars and exposures.
    chip : Chip
        The chip of the table.
    step : tuple of float
        Pixels between nodes along x and y.
    taken : callable
        Variance (n, 2) of table and polynomial at pixels x, y (n,), square pixels: the part of the
        residuals that the fit absorbed.  It is negative for a table that was not fitted to them,
        because the products then include the error of the table.

    Returns
    -------
    BetweenNodes

    Raises
    ------
    DegenerateError
        If too few stars are close to each other, or in too few positions.
    """
    used = (precision > 0).all(axis=1)
    stars = x[used], y[used], residual[used], precision[used], star[used], exposure[used]
    fine, coarse = (_pairs(_NodeCells.of(chip, step, parts), *stars) for parts in (FINE, COARSE))
    n_pairs = round(float(fine.number.sum()) / 2)
    part = fine.cells.areas(chip)
    is_measured = ((fine.weight > 0) & (coarse.weight > 0)).all(axis=1) & (part > 0)
    if n_pairs < MIN_PAIRS or not is_measured.any():
        raise DegenerateError(
            f"{n_pairs} pairs of stars at the same position do not show what lies between nodes",
            where=f"look-up table of chip {chip.number}",
            do="give more stars or more exposures",
        )
    common = _of_stars(*stars[2:5])
    square, error = np.empty(2), np.empty(2)
    for a in (0, 1):
        near, far = fine.weight[is_measured, a], coarse.weight[is_measured, a]
        each = (
            AREA_RATIO * (fine.product[is_measured, a] / near)
            - coarse.product[is_measured, a] / far
        )
        each /= AREA_RATIO - 1
        # pairs in a fine cell are also pairs in the coarse cell around it
        fine_scatter = fine.scatter(a)
        noise = AREA_RATIO**2 * (fine_scatter / near) - 2 * AREA_RATIO * (fine_scatter / far)
        noise = (noise + coarse.scatter(a) / far) / (AREA_RATIO - 1) ** 2
        size = max(float(np.average(each, weights=1 / noise)), 0.0)
        for _ in range(MAX_ITERATIONS):
            # squares differ by about their size: if they are well determined, weight them by area
            weight = 1 / (noise + size**2 / part[is_measured])
            weight /= weight.sum()
            square[a] = weight @ each + fine.average(taken, a, is_measured, weight)
            size = max(square[a], 0.0)
        off = -part / part.sum()
        off[is_measured] += weight
        uneven = size**2 * np.sum(off[part > 0] ** 2 / part[part > 0])
        error[a] = np.sqrt(weight**2 @ noise + uneven + 4 * size * common[a])
    return BetweenNodes(chip.number, square, error, n_pairs)


def _of_stars(residual: Float, precision: Float, star: Int) -> Float:
    """Variance (2,) of the mean of all residuals due to independent errors of the stars."""
    return squares_over(star, precision * residual)[0] / precision.sum(axis=0) ** 2


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Sums over ordered pairs of different stars in different exposures and the same cell."""

    cells: _NodeCells
    by_cell: Float  # (cells, 2) weights
    # product, weight, spread (squares, 2): products and weights per square, and variance of the
    # products due to independent errors of the stars
    product: Float
    weight: Float
    spread: Float
    number: Float  # (squares,) number of ordered pairs

    def scatter(self, a: int) -> float:
        """Noise of mean products along one axis, times their weight."""
        return float(self.spread[:, a].sum() / self.weight[:, a].sum())

    def average(
        self,
        function: Callable[[Float, Float], Float],
        a: int,
        seen: Bool,
        weight: Float,
    ) -> float:
        """Weighted mean along one axis of a function (n, 2) of position.

        `weight` applies to squares.
        """
        each = np.zeros(len(seen))
        each[seen] = weight / self.weight[seen, a]
        of_cell = self.by_cell[:, a] * each[self.cells.squares()]
        with_weight = np.flatnonzero(of_cell > 0)
        sampled = with_weight[:: max(1, len(with_weight) // CELLS_SAMPLED)]
        values = function(*self.cells.centres(sampled))[:, a]
        return float(np.average(values, weights=of_cell[sampled]))


def _pairs(
    cells: _NodeCells,
    x: Float,
    y: Float,
    residual: Float,
    precision: Float,
    star: Int,
    exposure: Int,
) -> _Pairs:
    cell, n = cells.of_pixels(x, y), cells.number
    p = precision * residual
    each = np.column_stack([p, precision, p**2, np.ones(len(p))])

    # From all pairs, those of one star and those of one exposure are subtracted; pairs of a
    # detection with itself, which were subtracted twice, are added.
    sums = squares_over(np.zeros_like(cell), each, cell, n)
    for of in (star, exposure):
        sums -= squares_over(of, each, cell, n)
    sums += squares_over(np.arange(len(cell)), each, cell, n)
    squares = cells.squares()
    by_square = sums_over(squares, sums)
    return _Pairs(
        cells,
        sums[:, 2:4],
        by_square[:, :2],
        by_square[:, 2:4],
        2 * by_square[:, 4:6],
        by_square[:, 6],
    )


@dataclass(frozen=True)
class _NodeCells:
    """Cells that divide the squares between nodes."""

    # pixel at the corner of the first cell: the node before the first node of the table
    origin: tuple[float, float]
    side: tuple[float, float]
    shape: tuple[int, int]  # number of cells along x and y
    parts: int  # number of cells along a side of a square

    @classmethod
    def of(cls, chip: Chip, step: tuple[float, float], parts: int) -> _NodeCells:
        """Cells of a chip, `parts` along each side of a square."""
        squares = [int(np.ceil(n / s - 1e-9)) + 1 for n, s in zip(chip.size, step, strict=True)]
        return cls(
            ((1 - step[0]) / 2, (1 - step[1]) / 2),
            (step[0] / parts, step[1] / parts),
            (squares[0] * parts, squares[1] * parts),
            parts,
        )

    @property
    def number(self) -> int:
        """Number of cells."""
        return self.shape[0] * self.shape[1]

    def of_pixels(self, x: Float, y: Float) -> Int:
        """Index (N,) of the cell of each pixel."""
        i, j = (
            np.clip(((p - o) // s).astype(np.int64), 0, n - 1)
            for p, o, s, n in zip((x, y), self.origin, self.side, self.shape, strict=True)
        )
        return j * self.shape[0] + i

    def centres(self, cells: Int) -> tuple[Float, Float]:
        """Pixels x and y of the centres of cells."""
        j, i = np.divmod(cells, self.shape[0])
        x, y = (o + (k + 0.5) * s for o, k, s in zip(self.origin, (i, j), self.side, strict=True))
        return x, y

    def areas(self, chip: Chip) -> Float:
        """Fraction of each square that is on the chip."""
        shares = []
        for o, s, n, size in zip(self.origin, self.side, self.shape, chip.size, strict=True):
            edges = o + s * self.parts * np.arange(n // self.parts + 1)
            shares.append(np.diff(np.clip(edges, 0.5, size + 0.5)) / (s * self.parts))
        return np.outer(shares[1], shares[0]).ravel()

    def squares(self) -> Int:
        """Index (cells,) of the square of each cell."""
        j, i = np.divmod(np.arange(self.number), self.shape[0])
        return j // self.parts * (self.shape[0] // self.parts) + i // self.parts


@dataclass(frozen=True, eq=False)
class MeanSquare:
    """Mean squares on two axes, given their measurements and that they are not negative."""

    measured: Float  # (2,) of u and v; may be negative because of noise
    error: Float  # (2,) standard deviations of the measurements, independent of each other

    @property
    def mean(self) -> Float:
        """Mean (2,) of the normal distribution N(measured, error^2), truncated at zero.

        It increases with the error: less knowledge does not make the result smaller.
        """
        return self._moments[0]

    @property
    def relative_error(self) -> float:
        """Relative error of the radial rms."""
        mean, variance = self._moments
        total = mean.sum()
        return float(np.sqrt(variance.sum()) / (2 * total)) if total > 0 else 0.0

    def relative_draws(self, n: int, rng: np.random.Generator) -> Float:
        """Draws (n, 2) of the mean squares relative to their mean."""
        from scipy.stats import truncnorm  # takes a second to import, and few runs have tables

        mean, variance = self._moments
        out = np.ones((n, 2))
        for axis in np.flatnonzero(variance > 0):
            centre, width = self.measured[axis], self.error[axis]
            cut = truncnorm(-centre / width, np.inf, centre, width)
            out[:, axis] = cut.rvs(n, random_state=rng) / mean[axis]
        return out

    @property
    def _moments(self) -> tuple[Float, Float]:
        exact = self.error <= 0
        error = np.where(exact, 1.0, self.error)
        z = self.measured / error
        # density over probability, in logarithms: z is far below zero if errors are too small
        ratio = np.exp(-(z**2) / 2 - log_ndtr(z)) / np.sqrt(2 * np.pi)
        mean = np.where(exact, np.maximum(self.measured, 0.0), error * (z + ratio))
        variance = error**2 * np.maximum(1 - ratio * (z + ratio), 0.0)
        return mean, np.where(exact, 0.0, variance)
