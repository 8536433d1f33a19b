"""Residuals averaged over the detector, their statistics, and the area that the stars cover.

Outside of the area of a chip that its stars cover, a polynomial is extrapolated.  The formal and
posterior errors are valid there only if the model is, and no star can test that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, QhullError

from bayesdist.errors import InputError, require_known
from bayesdist.model import Chip
from bayesdist.model.grid import mesh
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.checks import UNCOVERED, UNCOVERED_BY_CHANCE

BAND_AXES = ("X", "Y", "radial")
_BLOCK = 2**16  # stars
SPARSE = 0.02  # fraction of the typical density below which stars are strays rather than coverage
_FINE = (65, 65)


@dataclass(frozen=True, eq=False)
class BinnedResiduals:
    """Mean residuals on a grid of equal bins that cover the detector."""

    x: Float  # (nx,) centres of the bins, FITS 1-based pixels
    y: Float  # (ny,) likewise
    # mean_u, mean_v (ny, nx): NaN in an empty bin
    mean_u: Float
    mean_v: Float
    count: Int  # (ny, nx) number of stars
    # sem_u, sem_v (ny, nx): standard errors of the means from the scatter in the bin; NaN for fewer
    # than two stars
    sem_u: Float
    sem_v: Float
    # number of stars outside of the detector, which are in no bin
    n_outside: int = 0


@dataclass(frozen=True, eq=False)
class BinValues:
    """Means of one quantity in bins."""

    # mean, sem (ny, nx): means and their standard errors; NaN for too few stars
    mean: Float
    sem: Float
    dof: Float  # (ny, nx) degrees of freedom of the standard errors: number of stars minus one

    @property
    def good(self) -> Bool:
        """Boolean mask of the bins with a standard error."""
        return np.isfinite(self.mean) & np.isfinite(self.sem)

    def scaled(self, factor: float) -> BinValues:
        """Means multiplied by a factor."""
        return BinValues(self.mean * factor, self.sem * abs(factor), self.dof)

    def minus(self, other: BinValues) -> BinValues:
        """Differences between bins, with independent errors."""
        var = self.sem**2, other.sem**2
        total = var[0] + var[1]
        with np.errstate(invalid="ignore", divide="ignore"):
            # Satterthwaite's degrees of freedom of a sum of variances
            dof = total**2 / (var[0] ** 2 / self.dof + var[1] ** 2 / other.dof)
        return BinValues(self.mean - other.mean, np.sqrt(total), dof)


@dataclass(frozen=True, eq=False)
class BinnedSums:
    """Sums of residuals in equal bins that cover the detector.

    Sums over parts of the data can be added.
    """

    size: tuple[float, float]  # numbers of columns and rows of the detector
    count: Int  # (ny, nx) number of stars
    # first, second (q, ny, nx): sums of u, v and further quantities, and of their squares
    first: Float
    second: Float
    # number of stars outside of the detector, which are in no bin
    n_outside: int = 0
    # (ny, nx) sums of the products of u and v; None if the errors of both are not correlated
    mixed: Float | None = None

    def __add__(self, other: BinnedSums) -> BinnedSums:
        if self.size != other.size or self.count.shape != other.count.shape:
            raise ValueError("sums over different bins do not add")
        mixed = None
        if self.mixed is not None and other.mixed is not None:
            mixed = self.mixed + other.mixed
        return BinnedSums(
            self.size,
            self.count + other.count,
            self.first + other.first,
            self.second + other.second,
            self.n_outside + other.n_outside,
            mixed,
        )

    @property
    def n(self) -> int:
        """Number of stars in all bins."""
        return int(self.count.sum())

    @property
    def means(self) -> tuple[Float, Float]:
        """Means (q, ny, nx), and their standard errors from the scatter in the bins."""
        count = self.count.astype(np.float64)
        mean = _ratio(self.first, count)
        about = np.nan_to_num(mean)
        spread = self.second - 2 * about * self.first + about**2 * count
        # rounding may make a zero scatter slightly negative
        variance = _ratio(np.maximum(spread, 0.0), count**2)
        return mean, np.sqrt(variance * _ratio(count, count - 1.0))

    @property
    def covariance(self) -> Float | None:
        """Covariance (ny, nx) of the means of u and v from the scatter in the bins.

        None without `mixed`.
        """
        if self.mixed is None:
            return None
        count = self.count.astype(np.float64)
        mean = np.nan_to_num(_ratio(self.first, count))
        spread = self.mixed - mean[0] * mean[1] * count
        return np.asarray(_ratio(_ratio(spread, count), count - 1.0))

    def residuals(self) -> BinnedResiduals:
        """Means of u and v, with their standard errors and the centres of the bins."""
        mean, sem = self.means
        ny, nx = self.count.shape
        edges_x, edges_y = _edges(self.size[0], nx), _edges(self.size[1], ny)
        return BinnedResiduals(
            x=(edges_x[:-1] + edges_x[1:]) / 2,
            y=(edges_y[:-1] + edges_y[1:]) / 2,
            mean_u=mean[0],
            mean_v=mean[1],
            count=self.count,
            sem_u=sem[0],
            sem_v=sem[1],
            n_outside=self.n_outside,
        )

    def values(self, axis: str) -> BinValues:
        """Means of the bins along one axis, for sums from `band_bins`.

        `axis` is one of `BAND_AXES`; raises InputError otherwise.
        """
        require_known(axis, BAND_AXES, "axis")
        k = BAND_AXES.index(axis)
        mean, sem = self.means
        return BinValues(mean[k], sem[k], np.maximum(self.count - 1.0, 0.0))


def binned_residuals(
    x: ArrayLike,
    y: ArrayLike,
    ru: ArrayLike,
    rv: ArrayLike,
    *,
    bins: int | tuple[int, int],
    size: tuple[float, float],
) -> BinnedResiduals:
    """Residuals averaged in bins of the detector; for parameters and errors see `binned_sums`."""
    return binned_sums(x, y, ru, rv, bins=bins, size=size).residuals()


def binned_sums(
    x: ArrayLike,
    y: ArrayLike,
    ru: ArrayLike,
    rv: ArrayLike,
    *more: ArrayLike,
    bins: int | tuple[int, int],
    size: tuple[float, float],
    mixed: bool = False,
) -> BinnedSums:
    """Sums of residuals in bins of the detector.

    Parameters
    ----------
    x, y : array_like, shape (N,)
        FITS 1-based pixels.
    ru, rv : array_like, shape (N,)
        Residuals, data minus model.
    *more : array_like, shape (N,)
        Further quantities of each star.
    bins : int or tuple of int
        Number of bins in x and y.
    size : tuple of float
        Numbers of columns and rows of the detector; the bins extend from 0.5 to size + 0.5.
    mixed : bool, optional
        True to sum the products of both residuals as well.

    Returns
    -------
    BinnedSums

    Raises
    ------
    InputError
        If lengths differ, values are not finite, or the number of bins is not positive.
    """
    nx, ny = (bins, bins) if isinstance(bins, int | np.integer) else bins
    if min(nx, ny) < 1 or int(nx) != nx or int(ny) != ny:
        raise InputError(f"the number of bins is {bins}", do="give whole numbers of at least 1")
    columns = [np.asarray(a, float) for a in (x, y, ru, rv, *more)]
    if columns[0].ndim != 1 or len({a.shape for a in columns}) != 1:
        raise InputError(
            "positions and residuals differ in length", do="give one residual for each position"
        )

    def sums_from(start: int) -> BinnedSums:
        """Sums of one block, small enough for its temporary arrays to stay in the cache."""
        block = [a[start : start + _BLOCK] for a in columns]
        if not all(np.isfinite(a).all() for a in block):
            raise InputError("a position or residual is not finite", do="leave that star out")
        sizes = float(size[0]), float(size[1])
        return _block_sums(block, int(nx), int(ny), sizes, mixed=mixed)

    out = sums_from(0)
    for start in range(_BLOCK, len(columns[0]), _BLOCK):
        out = out + sums_from(start)
    return out


def _block_sums(
    block: Sequence[Float], nx: int, ny: int, size: tuple[float, float], *, mixed: bool
) -> BinnedSums:
    """Sums over the stars of a block."""
    x, y, *residuals = block
    edges_x, edges_y = _edges(size[0], nx), _edges(size[1], ny)
    inside = (x >= edges_x[0]) & (x <= edges_x[-1]) & (y >= edges_y[0]) & (y <= edges_y[-1])
    n_outside = int(inside.size - inside.sum())
    if n_outside:
        x, y, *residuals = (a[inside] for a in block)
    index = _bin(y, edges_y) * nx + _bin(x, edges_x)

    def total(values: Float | None = None) -> NDArray[Any]:
        return np.bincount(index, values, minlength=nx * ny).reshape(ny, nx)

    first, second = (np.stack([total(r**k) for r in residuals]) for k in (1, 2))
    products = total(residuals[0] * residuals[1]) if mixed else None
    return BinnedSums(size, total().astype(np.int64), first, second, n_outside, products)


def band_bins(
    x: ArrayLike,
    y: ArrayLike,
    ru: ArrayLike,
    rv: ArrayLike,
    *,
    bins: int | tuple[int, int],
    size: tuple[float, float],
) -> BinnedSums:
    """Sums of residuals and of their lengths in bins, as in section 5 of WSDC D-T033.

    The mean length of a bin is that of single stars rather than the length of the mean residual.
    For the parameters see `binned_sums`; section 5 of WSDC D-T033 uses 31 bins and Appendix C uses
    45.
    """
    length = np.hypot(np.asarray(ru, float), np.asarray(rv, float))
    return binned_sums(x, y, ru, rv, length, bins=bins, size=size)


def _edges(size: float, n: int) -> Float:
    """Edges (n + 1,) of n equal bins over `size` pixels."""
    return np.linspace(0.5, size + 0.5, n + 1)


def _bin(values: Float, edges: Float) -> Int:
    """Bin of each value between the edges; the last edge belongs to the last bin."""
    n = edges.size - 1
    guess = (values - edges[0]) * (n / (edges[-1] - edges[0]))
    index = np.clip(guess.astype(np.int64), 0, n - 1)
    # compare with the edges, because the first guess is rounded
    index -= values < edges[index]
    index += values >= edges[index + 1]
    return np.minimum(index, n - 1)


def _ratio(a: Float, b: Float) -> Float:
    """Ratios; NaN if the denominator is not positive."""
    b = np.broadcast_to(b, a.shape)
    return np.divide(a, b, out=np.full(a.shape, np.nan), where=b > 0)


@dataclass(frozen=True, eq=False)
class Coverage:
    """Convex area of a chip that its stars span."""

    chip: Chip
    several: bool  # True if the detector has several chips
    # (m, 3) coefficients (a, b, c); a x + b y + c is the distance outside of a side of the area
    sides: Float
    gap: float  # fraction of the chip's area outside
    known: bool  # True if an earlier calibration, used as the prior, covers the remaining area
    by_chance: float  # average gap for this number of evenly distributed stars

    @property
    def significant(self) -> bool:
        """True if the gap is so large that corners or edges are extrapolated."""
        return not self.known and self.gap > self.most

    @property
    def most(self) -> float:
        """Largest acceptable fraction of the chip's area outside."""
        return max(UNCOVERED.value, UNCOVERED_BY_CHANCE.value * self.by_chance)

    @property
    def sentence(self) -> str:
        """Meaning of the gap, as a clause."""
        part = f"chip {self.chip.name}" if self.several else "the detector"
        (x_low, x_high), (bottom, top) = self.extent
        return (
            f"{100 * self.gap:.0f} % of {part} lies beyond the area that its stars cover (within "
            f"x {x_low:.0f} to {x_high:.0f}, y {bottom:.0f} to {top:.0f}): there the "
            "polynomial is extrapolated, and its errors are not known"
        )

    @property
    def extent(self) -> Float:
        """Range of the area in x, then in y, pixels, shape (2, 2)."""
        on_chip = [(0.5, n + 0.5) for n in self.chip.size]
        reach = np.eye(2)[:, None] * [[1.0], [-1.0]]  # directions that minimise x, -x, y and -y
        corners = [
            [linprog(way, self.sides[:, :2], -self.sides[:, 2], bounds=on_chip).x for way in axis]
            for axis in reach
        ]
        return np.einsum("aca->ac", np.array(corners))

    def within(self, field: Callable[[Float, Float], Bool]) -> Coverage:
        """Coverage of the illuminated part of the chip; `field` is True for its pixels."""
        x, y = _fine_pixels(self.chip)
        inside = field(x, y)
        if not inside.any():
            return self
        return replace(self, gap=float((self.beyond(x, y)[inside] > 0).mean()))

    def beyond(self, x: Float, y: Float) -> Float:
        """Distance (N,) of pixels outside of the area; negative inside."""
        return np.asarray((self.sides @ np.stack([x, y, np.ones_like(x)])).max(axis=0))


def coverage_of(
    sums: BinnedSums, corners: Float, chip: Chip, *, several: bool = False, known: bool = False
) -> Coverage:
    """Area of a chip that its stars cover.

    It is inside the convex hull of all stars and inside that of the cells with more than a few
    strays:  a few false matches in the corners do not cover them.

    `sums` are those of the stars used, `corners` (m, 2) are the vertices of the convex hull of all
    stars (`ChipSurvey.corners`).  `several` is True if the detector has several chips, and `known`
    if an earlier calibration covers the remaining area.

    The gap that n evenly distributed stars leave in a rectangle is (8/3) ln n / n of its area
    (Renyi & Sulanke 1963, Z. Wahrscheinlichkeitstheorie 2, 75).
    """
    count, size = sums.count, np.array(chip.size)
    n = int(count.sum())
    ny, nx = count.shape
    # density that half of the stars do not exceed in their cells
    ordered = np.sort(count.ravel())
    usual = ordered[np.searchsorted(np.cumsum(ordered), n / 2)]
    iy, ix = np.nonzero(count > max(1.0, SPARSE * usual))
    cells = (
        np.concatenate([np.column_stack([ix + a, iy + b]) for a in (0, 1) for b in (0, 1)])
        * (size / [nx, ny])
        + 0.5
    )
    sides = np.concatenate([_sides(cells), _sides(corners)])
    x, y = _fine_pixels(chip)
    beyond = (sides @ np.stack([x, y, np.ones_like(x)])).max(axis=0) > 0
    chance = 8 / 3 * np.log(max(n, 2)) / max(n, 2)
    return Coverage(chip, several, sides, float(beyond.mean()), known, float(chance))


def _fine_pixels(chip: Chip) -> tuple[Float, Float]:
    """Centres (N,) of equal cells on a chip, for counting areas."""
    step = [(np.arange(k) + 0.5) / k for k in _FINE]
    return mesh(*(s * length + 0.5 for s, length in zip(step, chip.size, strict=True)))


def _sides(points: Float) -> Float:
    """Sides of the convex hull; one that excludes nothing if the points span no area."""
    try:
        return np.asarray(ConvexHull(points).equations)
    except (QhullError, ValueError):
        return np.array([[0.0, 0.0, -1.0]])
