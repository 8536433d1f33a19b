"""Matern field of the node values: its marginal likelihood, and the most probable one.

With the polynomial integrated out (REML) the stars give on each axis a rough estimate of the node
values, d = B b, that scatters about the truth with covariance B.  The truth is a field with
covariance C, so d is Gaussian with covariance C + B: one Cholesky factor for each set of
hyperparameters, however many the stars.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
from scipy.optimize import minimize

from bayesdist.infer.nodes.grid import NodeGrid
from bayesdist.infer.nodes.sums import NodeSums
from bayesdist.utils.arrays import Float, Int

SMOOTHNESS = (0.5, 1.5, 2.5)

# Fraction of the variance that each node has independently: a field that is very smooth on the grid
# has a covariance that no computer can factor. 1e-9 is 3e-5 of the amplitude.
NUGGET = 1e-9
# A bin without stars is given one observation of zero, 1e4 times worse than the typical bin's: it
# does not constrain a pattern of any size and keeps B finite. (The posterior needs no such help.)
EMPTY = 1e-8
TILE = 16  # nodes: the search starts on independent tiles of the chip
LOG_LENGTH = (np.log(2.0), 1.0)  # prior of log(length / step): mean, standard deviation
SETTLED = 0.02  # gain in log density at which the search stops
UNKNOWN = np.diag([0.04, 0.04])  # of log amplitude and log length, before the first differences
RULED_OUT = 10.0  # a smoothness so much worse on the tiles is not tried again


@dataclass(frozen=True)
class Matern:
    """Stationary Gaussian random field (Rasmussen and Williams 2006, Equation 4.14)."""

    amplitude: float  # standard deviation, pixels
    length: float  # correlation length, pixels
    smoothness: float  # 1/2, 3/2 or 5/2: a rough field, one with a slope, one with a curvature

    def correlation(self, distance: Float) -> Float:
        """Correlation of two points at a distance in pixels."""
        t = np.sqrt(2 * self.smoothness) * np.asarray(distance, float) / self.length
        shape = {0.5: 1.0, 1.5: 1.0 + t, 2.5: 1.0 + t + t**2 / 3}[self.smoothness]
        return shape * np.exp(-t)

    def covariance(self, grid: NodeGrid) -> Float:
        """Covariance (n_nodes, n_nodes) of free node values."""
        by_lag = self.amplitude**2 * self.correlation(grid.lags)
        by_lag[0] += self.amplitude**2 * NUGGET
        return by_lag[grid.lag]

    def restricted(self, grid: NodeGrid) -> Float:
        """Covariance (n_nodes, n_nodes) of node values without their polynomial part."""
        return grid.without_their_polynomials(self.covariance(grid))


@dataclass(frozen=True, eq=False)
class FittedField:
    """Hyperparameters of one axis at their most probable values."""

    prior: Matern
    covariance: Float  # of log amplitude and log length (2, 2), from the curvature there
    log_evidence: float  # log marginal likelihood there, up to a constant


@dataclass(frozen=True, eq=False)
class Evidence:
    """Marginal likelihood of the hyperparameters of one axis."""

    grid: NodeGrid
    sums: NodeSums

    @cached_property
    def noise(self) -> Float:
        """Covariance B (n, n) of the rough node values."""
        Q, A = self.grid.polynomials, self.sums.information
        scale = np.median(np.diag(A)[np.diag(A) > 0])
        A = self.grid.without_their_polynomials(A)
        A += scale * (Q @ Q.T)
        A[np.diag_indices_from(A)] += EMPTY * scale
        inverse, _ = scipy.linalg.lapack.dpotri(cholesky(A), lower=1, overwrite_c=1)
        return np.tril(inverse) + np.tril(inverse, -1).T

    @cached_property
    def rough(self) -> Float:
        """Rough node values (n,), without any smoothing."""
        return self.noise @ self.grid.without_polynomials(self.sums.marginal_right)

    def log_likelihood(self, prior: Matern) -> float:
        """Log marginal likelihood, up to a constant that does not depend on the prior."""
        V = prior.restricted(self.grid)
        V += self.noise
        L = cholesky(V)
        z = scipy.linalg.solve_triangular(L, self.rough, lower=True, check_finite=False)
        return float(-0.5 * z @ z - np.log(np.diag(L)).sum())

    @cached_property
    def _tiles(self) -> Int:
        """Nodes (T, m) of equal tiles that cover the chip except for a margin."""
        ny, nx = self.grid.shape
        my, mx = min(TILE, ny), min(TILE, nx)
        nodes = np.arange(ny * nx).reshape(ny, nx)
        corners = [(j, i) for j in range(0, ny - my + 1, my) for i in range(0, nx - mx + 1, mx)]
        return np.array([nodes[j : j + my, i : i + mx].ravel() for j, i in corners])

    @cached_property
    def _tile_parts(self) -> tuple[Int, Float, Float]:
        """Lags of a tile (m, m), and B (T, m, m) and rough values (T, m) of all tiles."""
        tiles = self._tiles
        lag = self.grid.lag[np.ix_(tiles[0], tiles[0])]
        noise = self.noise[tiles[:, :, None], tiles[:, None, :]]
        return lag, noise, self.rough[tiles]

    def tiled_log_likelihood(self, prior: Matern) -> float:
        """Log marginal likelihood of independent tiles: a good start at a hundredth of the cost."""
        lag, noise, rough = self._tile_parts
        by_lag = prior.amplitude**2 * prior.correlation(self.grid.lags)
        by_lag[0] += prior.amplitude**2 * NUGGET
        out = 0.0
        for B, b in zip(noise, rough, strict=True):
            L = cholesky(by_lag[lag] + B)
            z = scipy.linalg.solve_triangular(L, b, lower=True, check_finite=False)
            out -= 0.5 * z @ z + np.log(np.diag(L)).sum()
        return float(out)

    def log_prior(self, prior: Matern) -> float:
        """Log prior density of log amplitude and log length, up to a constant.

        The density of the amplitude itself rises in proportion to it: this keeps the most probable
        value from zero, where it would claim certainty (Chung et al. 2013, Psychometrika 78, 685).
        The length is about a few steps: it matters only where there is hardly any pattern.
        """
        mean, sd = LOG_LENGTH
        step = float(np.sqrt(np.prod(self.grid.step)))
        off = (np.log(prior.length / step) - mean) / sd
        return 2 * float(np.log(prior.amplitude)) - 0.5 * float(off**2)

    @cached_property
    def start(self) -> tuple[float, float]:
        """Starting log amplitude and log length, from the scatter of the rough values."""
        noise = np.diag(self.noise)
        known = noise < 100 * np.median(noise)
        excess = np.mean(self.rough[known] ** 2) - np.mean(noise[known])
        amplitude = np.sqrt(max(float(excess), 0.01 * float(np.mean(noise[known]))))
        return float(np.log(amplitude)), float(np.log(2 * np.sqrt(np.prod(self.grid.step))))


def fitted_field(evidence: Evidence, smoothness: Sequence[float], *, thorough: bool) -> FittedField:
    """Most probable amplitude, length and smoothness of the given ones.

    If `thorough` the whole chip is used after the tiles.
    """

    def density(nu: float, whole: bool) -> Callable[[Float], float]:
        likelihood = evidence.log_likelihood if whole else evidence.tiled_log_likelihood

        def of(point: Float) -> float:
            prior = _prior(point, nu)
            return likelihood(prior) + evidence.log_prior(prior)

        return of

    found: dict[float, tuple[Float, Float, float]] = {}
    for nu in smoothness:
        tiled = density(nu, False)
        rough = minimize(
            lambda p, f=tiled: -f(p),
            evidence.start,
            method="Nelder-Mead",
            bounds=_bounds(evidence),
            options={"xatol": 0.1, "fatol": 0.5, "maxfev": 100},
        )
        found[nu] = _summit(tiled, rough.x)
    best = max(top for _, _, top in found.values())
    if thorough:
        for nu in smoothness:
            if found[nu][2] > best - RULED_OUT:
                found[nu] = _summit(density(nu, True), found[nu][0], covariance=found[nu][1])
            else:
                found[nu] = (*found[nu][:2], -np.inf)
    chosen = max(found, key=lambda nu: found[nu][2])
    point, covariance, top = found[chosen]
    return FittedField(_prior(point, chosen), covariance, top)


def refined_field(evidence: Evidence, earlier: FittedField) -> FittedField:
    """Most probable amplitude and length, starting from those of nearly the same data."""
    nu = earlier.prior.smoothness

    def density(point: Float) -> float:
        prior = _prior(point, nu)
        return evidence.log_likelihood(prior) + evidence.log_prior(prior)

    start = np.log([earlier.prior.amplitude, earlier.prior.length])
    point, covariance, top = _summit(density, start, covariance=earlier.covariance)
    return FittedField(_prior(point, nu), covariance, top)


def _prior(point: Float, nu: float) -> Matern:
    return Matern(float(np.exp(point[0])), float(np.exp(point[1])), nu)


def _bounds(evidence: Evidence) -> list[tuple[float, float]]:
    """Bounds of log amplitude and log length: far beyond the range that a grid can show."""
    amplitude, _ = evidence.start
    step = np.log(np.sqrt(np.prod(evidence.grid.step)))
    extent = np.log(max(evidence.grid.chip.size))
    return [(amplitude - 5.0, amplitude + 5.0), (step - 2.0, extent + 1.0)]


def _summit(
    density: Callable[[Float], float], start: Float, *, covariance: Float = UNKNOWN
) -> tuple[Float, Float, float]:
    """Maximum of a smooth function of two variables, the covariance there, and its value.

    Newton's method on differences of half a standard error: a few steps from a good start, and the
    curvature is obtained too.  It ends where the parabola has foretold the value at its own top.
    """
    x = np.asarray(start, float)
    h, f = _widths(covariance), density(x)
    for _ in range(8):
        ends = np.array([[density(x + s * h[k] * np.eye(2)[k]) for s in (1, -1)] for k in (0, 1)])
        corner = density(x + h)
        slope = (ends[:, 0] - ends[:, 1]) / (2 * h)
        curvature = np.diag((ends[:, 0] - 2 * f + ends[:, 1]) / h**2)
        cross = corner - ends[0, 0] - ends[1, 0] + f
        curvature[0, 1] = curvature[1, 0] = cross / (h[0] * h[1])
        values, vectors = np.linalg.eigh(-curvature)
        # uphill even where the curvature has the wrong sign
        values = np.maximum(np.abs(values), 1e-3 * np.abs(values).max() + 1e-6)
        covariance = (vectors / values) @ vectors.T
        step = covariance @ slope
        gain = 0.5 * float(slope @ step)
        shorter = min(1.0, 1.0 / float(np.abs(step).max() + 1e-300))
        x, foretold = x + step * shorter, f + gain * shorter * (2 - shorter)
        if gain < SETTLED:
            return x, covariance, foretold
        h, f = _widths(covariance), density(x)
        if shorter == 1.0 and abs(f - foretold) < SETTLED:
            break
    return x, covariance, f


def _widths(covariance: Float) -> Float:
    return np.clip(0.5 * np.sqrt(np.diag(covariance)), 0.01, 0.3)


def cholesky(matrix: Float) -> Float:
    """Lower factor of a symmetric matrix, which is overwritten."""
    # the transpose of a C array has the order of LAPACK, and the matrix is symmetric
    L, failed = scipy.linalg.lapack.dpotrf(matrix.T, lower=1, clean=1, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return L
