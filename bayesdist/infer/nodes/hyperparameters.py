"""Matern field of the node values: its marginal likelihood, and the most probable one.

With the polynomial integrated out (REML) the stars give on each axis a rough estimate of the node
values, d = B b, that scatters about the truth with covariance B.  The truth is a field with
covariance C, so d is Gaussian with covariance C + B: one Cholesky factor for each set of
hyperparameters, however many the stars.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import scipy.linalg
import scipy.optimize

from bayesdist.infer.kernel.lapack import cholesky, inverse_of
from bayesdist.infer.nodes.grid import NodeGrid
from bayesdist.infer.nodes.sums import NodeSums
from bayesdist.utils.arrays import Float, Int

SMOOTHNESS = (0.5, 1.5, 2.5)

# Fraction of the variance that each node has independently: a field that is very smooth on the grid
# has a covariance that no computer can factor. 1e-9 is 3e-5 of the amplitude.
NUGGET = 1e-9
# A bin without stars is given one observation of zero, 1e4 times worse than the typical bin's: it
# does not constrain a pattern of any size and keeps B finite.
EMPTY = 1e-8
TILE = 16  # nodes: the search starts on independent tiles of the chip
LOG_LENGTH = (np.log(2.0), 1.0)  # prior of log(length / step): mean, standard deviation
SETTLED = 0.02  # gain in log density at which the search stops
STEPS = 30  # far more than it takes
RULED_OUT = 10.0  # a smoothness so much worse on the tiles is not tried again
UNFORESEEN = 5.0  # far more than the ratio of a gain in log density to what a step promises


@dataclass(frozen=True)
class Matern:
    """Stationary Gaussian random field (Rasmussen and Williams 2006, Equation 4.14)."""

    amplitude: float  # standard deviation, pixels
    length: float  # correlation length, pixels
    smoothness: float  # 1/2, 3/2 or 5/2: a rough field, one with a slope, one with a curvature

    def by_lag(self, distance: Float) -> tuple[Float, Float]:
        """Covariance of nodes (n,) pixels apart, and its derivative by the logarithm of the length.

        The first distance is zero.
        """
        t = np.sqrt(2 * self.smoothness) * np.asarray(distance, float) / self.length
        scale = self.amplitude**2 * np.exp(-t)
        shape = {0.5: 1.0, 1.5: 1.0 + t, 2.5: 1.0 + t + t**2 / 3}[self.smoothness]
        slope = {0.5: t, 1.5: t**2, 2.5: t**2 * (1.0 + t) / 3}[self.smoothness]
        covariance = scale * shape
        covariance[0] += self.amplitude**2 * NUGGET
        return covariance, scale * slope

    def covariance(self, grid: NodeGrid) -> Float:
        """Covariance (n_nodes, n_nodes) of free node values."""
        return self.by_lag(grid.lags)[0][grid.lag]

    def restricted(self, grid: NodeGrid) -> Float:
        """Covariance (n_nodes, n_nodes) of node values without their polynomial part."""
        return grid.without_their_polynomials(self.covariance(grid))


@dataclass(frozen=True, eq=False)
class FittedField:
    """Log density of one axis at some hyperparameters, and the field that goes with them."""

    prior: Matern
    log_evidence: float  # log density of amplitude and length, up to a constant
    slope: Float  # of it by log amplitude and log length (2,)
    curvature: Float  # minus its second derivatives, nearly (2, 2)
    mean: Float  # most probable node values (n,); of tiles, one after the other
    n_effective: float  # number of nodes that the stars determine

    @property
    def point(self) -> Float:
        """Log amplitude and log length (2,)."""
        return np.asarray(np.log([self.prior.amplitude, self.prior.length]))


@dataclass(frozen=True, eq=False)
class Evidence:
    """Marginal likelihood of the hyperparameters of one axis."""

    grid: NodeGrid
    sums: NodeSums

    @cached_property
    def _typical(self) -> float:
        """Median information about a node that has stars."""
        information = self.sums.nodes.diagonal()
        return float(np.median(information[information > 0]))

    @cached_property
    def noise(self) -> Float:
        """Covariance B (n, n) of the rough node values: its lower triangle, and zeros."""
        Q, A = self.grid.polynomials, self.sums.information
        A = self.grid.without_their_polynomials(A)
        A += self._typical * (Q @ Q.T)
        A[np.diag_indices_from(A)] += EMPTY * self._typical
        return inverse_of(cholesky(A))

    @cached_property
    def rough(self) -> Float:
        """Rough node values (n,), without any smoothing."""
        return _product(self.noise, self.grid.without_polynomials(self.sums.marginal_right))

    def at(self, prior: Matern) -> FittedField:
        """Log density of hyperparameters, and the field with them."""
        grid = self.grid
        out = _Parts(prior, grid)
        V = np.ascontiguousarray(prior.restricted(grid))
        bent = partial(_bent, grid, out.slope_by_lag)
        out.add(V, bent, self.noise, self.rough, grid.lag)
        # the field has no polynomials, of which the inverse of V has as much as that of B
        out.weights -= (1.0 + EMPTY) * self._typical * grid.polynomials_by_lag
        return out.field(_log_prior(grid, prior))

    @cached_property
    def _tiles(self) -> Int:
        """Nodes (T, m) of equal tiles that cover the chip except for a margin."""
        ny, nx = self.grid.shape
        my, mx = min(TILE, ny), min(TILE, nx)
        nodes = np.arange(ny * nx).reshape(ny, nx)
        corners = [(j, i) for j in range(0, ny - my + 1, my) for i in range(0, nx - mx + 1, mx)]
        return np.array([nodes[j : j + my, i : i + mx].ravel() for j, i in corners])

    @cached_property
    def _tile_parts(self) -> tuple[Int, list[Float], Float]:
        """Lags of a tile (m, m), and B (m, m) and rough values (T, m) of all tiles."""
        tiles = self._tiles
        lag = self.grid.lag[np.ix_(tiles[0], tiles[0])]
        noise = [np.asfortranarray(self.noise[np.ix_(tile, tile)]) for tile in tiles]
        return lag, noise, self.rough[tiles]

    def at_tiles(self, prior: Matern) -> FittedField:
        """As `at`, of independent tiles: a good start at a hundredth of the cost."""
        lag, noise, rough = self._tile_parts
        out = _Parts(prior, self.grid)
        bent = partial(np.matmul, out.slope_by_lag[lag])
        for B, b in zip(noise, rough, strict=True):
            out.add(np.ascontiguousarray(out.by_lag[lag]), bent, B, b, lag)
        return out.field(_log_prior(self.grid, prior))

    @cached_property
    def start(self) -> tuple[float, float]:
        """Starting log amplitude and log length, from the scatter of the rough values."""
        noise = np.diag(self.noise)
        known = noise < 100 * np.median(noise)
        excess = np.mean(self.rough[known] ** 2) - np.mean(noise[known])
        amplitude = np.sqrt(max(float(excess), 0.01 * float(np.mean(noise[known]))))
        return float(np.log(amplitude)), float(np.log(2 * np.sqrt(np.prod(self.grid.step))))


class _Parts:
    """Sums over the parts of a chip that are taken to be independent.

    With V = C + B and a = V^-1 b the slopes are (a^T V_k a - tr V^-1 V_k) / 2, and the curvature
    is the average information a^T V_k V^-1 V_l a / 2 (Gilmour, Thompson and Cullis 1995).  As
    C depends on the lag of two nodes alone, the trace is a sum over lags.
    """

    def __init__(self, prior: Matern, grid: NodeGrid) -> None:
        self.prior = prior
        self.by_lag, self.slope_by_lag = prior.by_lag(grid.lags)
        self.value = 0.0
        self.slope, self.curvature = np.zeros(2), np.zeros((2, 2))
        self.weights = np.zeros(grid.n_nodes)  # sums of V^-1 over pairs of nodes of one lag
        self.means: list[Float] = []

    def add(
        self, V: Float, bent: Callable[[Float], Float], noise: Float, rough: Float, lag: Int
    ) -> None:
        """Add a part of covariance V, which is overwritten; `bent` is V_2 times a vector."""
        V += noise.T
        L = cholesky(V)
        z = scipy.linalg.solve_triangular(L, rough, lower=True, check_finite=False)
        a = scipy.linalg.solve_triangular(L, z, lower=True, trans=1, check_finite=False)
        self.value -= float(0.5 * z @ z + np.log(np.diag(L)).sum())
        inverse = inverse_of(L)
        self.weights += 2 * np.bincount(lag.ravel(), inverse.T.ravel(), len(self.weights))
        self.weights[0] -= np.trace(inverse)
        mean = rough - _product(noise, a)
        moved = np.array([2 * mean, bent(a)])
        self.slope += 0.5 * moved @ a
        self.curvature += 0.5 * moved @ np.array([_product(inverse, one) for one in moved]).T
        self.means.append(mean)

    def field(self, log_prior: tuple[float, Float, Float]) -> FittedField:
        """Log density, with that of the prior and its slope and curvature."""
        value, slope, curvature = log_prior
        informed = float(self.by_lag @ self.weights)
        own = self.slope - 0.5 * np.array([2 * informed, self.slope_by_lag @ self.weights])
        # of a likelihood in the square of the amplitude, expressed by its logarithm
        curvature[0, 0] += max(0.0, -2 * own[0])
        return FittedField(
            self.prior,
            self.value + value,
            own + slope,
            self.curvature + curvature,
            np.concatenate(self.means),
            informed,
        )


def _bent(grid: NodeGrid, by_lag: Float, vector: Float) -> Float:
    """Product of a field's covariance (n, n), of which that by lag is given, with a vector."""
    return grid.without_polynomials(by_lag[grid.lag] @ vector)


def _product(lower: Float, vector: Float) -> Float:
    """Product of a symmetric matrix, of which the lower triangle is given, with a vector."""
    out: Float = scipy.linalg.blas.dsymv(1.0, lower, vector, lower=1)
    return out


def _log_prior(grid: NodeGrid, prior: Matern) -> tuple[float, Float, Float]:
    """Log prior density of log amplitude and log length, up to a constant; slope and curvature.

    The density of the amplitude itself rises in proportion to it: this keeps the most probable
    value from zero, where it would claim certainty (Chung et al. 2013, Psychometrika 78, 685).
    The length is about a few steps: it matters only where there is hardly any pattern.
    """
    mean, sd = LOG_LENGTH
    step = float(np.sqrt(np.prod(grid.step)))
    off = (np.log(prior.length / step) - mean) / sd
    value = 2 * float(np.log(prior.amplitude)) - 0.5 * float(off**2)
    return value, np.array([2.0, -off / sd]), np.diag([0.0, sd**-2])


def fitted_field(evidence: Evidence, smoothness: Sequence[float], *, thorough: bool) -> FittedField:
    """Most probable amplitude, length and smoothness of the given ones.

    They are searched on tiles, and if `thorough` on the whole chip from there.
    """
    starts = [evidence.at_tiles(_prior_at(evidence.start, nu)) for nu in smoothness]
    tiles = [_summit(evidence, evidence.at_tiles, start) for start in starts]
    best = max(one.log_evidence for one in tiles)
    likely = [one for one in tiles if one.log_evidence > best - RULED_OUT]
    if not thorough:
        return evidence.at(max(likely, key=lambda one: one.log_evidence).prior)
    whole = sorted((evidence.at(one.prior) for one in likely), key=lambda one: -one.log_evidence)
    found = _summit(evidence, evidence.at, whole[0])
    others = (_summit(evidence, evidence.at, one, found.log_evidence) for one in whole[1:])
    return max((found, *others), key=lambda one: one.log_evidence)


def _prior_at(point: Sequence[float] | Float, nu: float) -> Matern:
    """Prior of a log amplitude and log length."""
    amplitude, length = np.exp(point)
    return Matern(float(amplitude), float(length), nu)


def _bounds(evidence: Evidence) -> tuple[Float, Float]:
    """Bounds of log amplitude and log length: far beyond the range that a grid can show."""
    amplitude, _ = evidence.start
    step = np.log(np.sqrt(np.prod(evidence.grid.step)))
    extent = np.log(max(evidence.grid.chip.size))
    return np.array([amplitude - 5.0, step - 2.0]), np.array([amplitude + 5.0, extent + 1.0])


def _summit(
    evidence: Evidence,
    density: Callable[[Matern], FittedField],
    here: FittedField,
    best: float = -np.inf,
) -> FittedField:
    """Most probable amplitude and length for one smoothness, from `here` on by Newton's method.

    The curvature is corrected along the last step, by what the slope has changed there.  The search
    ends early where it will not come near the log density `best`.
    """
    low, high = _bounds(evidence)
    longest = 1.0
    curvature = here.curvature
    for _ in range(STEPS):
        step = _step(curvature, here.slope, low - here.point, high - here.point)
        step *= min(1.0, longest / float(np.abs(step).max() + 1e-300))
        gain = here.slope @ step - 0.5 * step @ curvature @ step
        if gain < SETTLED or here.log_evidence + UNFORESEEN * gain < best:
            break
        there = density(_prior_at(here.point + step, here.prior.smoothness))
        change = here.slope - there.slope
        if there.log_evidence > here.log_evidence:
            here, longest = there, 1.0
        else:
            longest = 0.5 * float(np.abs(step).max())
        curvature = _corrected(here.curvature, step, change)
    return here


def _step(curvature: Float, slope: Float, low: Float, high: Float) -> Float:
    """Newton's step (2,) within bounds: at one of them, the best along it."""
    root = np.linalg.cholesky(curvature)
    target = scipy.linalg.solve_triangular(root, slope, lower=True)
    found = scipy.optimize.lsq_linear(root.T, target, (low, high), method="bvls")
    return np.asarray(found.x, float)


def _corrected(curvature: Float, step: Float, change: Float) -> Float:
    """Curvature (2, 2) with the measured change of the slope along a step, if concave (BFGS)."""
    if change @ step <= 0:
        return curvature
    along = curvature @ step
    return (
        curvature
        - np.outer(along, along) / (step @ along)
        + np.outer(change, change) / (change @ step)
    )
