"""Matern field of the node values: marginal likelihood and most probable hyperparameters.

With the polynomial integrated out (REML), the stars give a rough estimate d = B b of the node
values on each axis, with covariance B about the true values.  The true values are a field with
covariance C, so d is Gaussian with covariance C + B.  Each set of hyperparameters therefore needs
one Cholesky factorisation, independent of the number of stars.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import scipy.linalg
import scipy.optimize

from bayesdist.infer.kernel.lapack import cholesky, inverse_of
from bayesdist.infer.nodes.grid import NodeGrid, NodeSums
from bayesdist.utils.arrays import Float, Int

SMOOTHNESS = (0.5, 1.5, 2.5)

# Independent fraction of the variance of each node. Without it the covariance of a field that is
# very smooth on the grid is numerically singular. 1e-9 is 3e-5 of the amplitude.
NUGGET = 1e-9
# Information added to each node, relative to a typical bin: an observation of zero with 1e4 times
# the typical error. It keeps B finite for empty bins without constraining the pattern.
EMPTY = 1e-8
TILE = 16  # nodes per side of the independent tiles on which the search starts
LOG_LENGTH = (np.log(2.0), 1.0)  # prior of log(length / step): mean, standard deviation
SETTLED = 0.02  # expected gain in log density at which the search stops
STEPS = 30  # maximum number of Newton steps; far fewer are needed
RULED_OUT = 10.0  # a smoothness worse by this log density on the tiles is not tried on the chip
UNFORESEEN = 5.0  # generous upper limit on the ratio of actual to predicted gain of a step


@dataclass(frozen=True)
class Matern:
    """Stationary Gaussian random field (Rasmussen and Williams 2006, Equation 4.14).

    Parameters
    ----------
    amplitude : float
        Standard deviation in pixels.
    length : float
        Correlation length in pixels.
    smoothness : float
        1/2 (not differentiable), 3/2 (once) or 5/2 (twice).
    """

    amplitude: float
    length: float
    smoothness: float

    def by_lag(self, distance: Float) -> tuple[Float, Float]:
        """Covariance (n,) at distances (n,) in pixels, and its derivative (n,).

        The derivative is with respect to the log length.  The first distance must be zero.
        """
        t = np.sqrt(2 * self.smoothness) * np.asarray(distance, float) / self.length
        scale = self.amplitude**2 * np.exp(-t)
        shape = {0.5: 1.0, 1.5: 1.0 + t, 2.5: 1.0 + t + t**2 / 3}[self.smoothness]
        slope = {0.5: t, 1.5: t**2, 2.5: t**2 * (1.0 + t) / 3}[self.smoothness]
        covariance = scale * shape
        covariance[0] += self.amplitude**2 * NUGGET
        return covariance, scale * slope

    def covariance(self, grid: NodeGrid) -> Float:
        """Covariance (n_nodes, n_nodes) of the node values, including their polynomial part."""
        return self.by_lag(grid.lags)[0][grid.lag]

    def restricted(self, grid: NodeGrid) -> Float:
        """Covariance (n_nodes, n_nodes) of node values without their polynomial part."""
        return grid.without_their_polynomials(self.covariance(grid))


@dataclass(frozen=True, eq=False)
class FittedField:
    """Log density of the hyperparameters of one axis at one point, and the node values there.

    Derivatives are with respect to log amplitude and log length.
    """

    prior: Matern
    log_evidence: float  # log density of amplitude and length, up to a constant
    slope: Float  # gradient (2,) of the log density
    curvature: Float  # minus the Hessian (2, 2), approximately
    mean: Float  # most probable node values (n,); concatenated over the tiles if there are several
    n_effective: float  # effective number of nodes that the stars determine

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
        """Median information (inverse variance) of the nodes that have stars."""
        information = self.sums.nodes.diagonal()
        return float(np.median(information[information > 0]))

    @cached_property
    def noise(self) -> Float:
        """Covariance B (n, n) of the rough node values; only the lower triangle is filled."""
        Q, A = self.grid.polynomials, self.sums.information
        A = self.grid.without_their_polynomials(A)
        A += self._typical * (Q @ Q.T)
        A[np.diag_indices_from(A)] += EMPTY * self._typical
        return inverse_of(cholesky(A))

    @cached_property
    def rough(self) -> Float:
        """Rough node values (n,), that is, without smoothing by the prior."""
        return _product(self.noise, self.grid.without_polynomials(self.sums.marginal_right))

    def at(self, prior: Matern) -> FittedField:
        """Log density of the hyperparameters, and the node values, for the field `prior`."""
        grid = self.grid
        out = _Parts(prior, grid)
        V = np.ascontiguousarray(prior.restricted(grid))
        bent = partial(_bent, grid, out.slope_by_lag)
        out.add(V, bent, self.noise, self.rough, grid.lag)
        # subtract the polynomial part of V^-1 (equal to that of B^-1), which the field lacks
        out.weights -= (1.0 + EMPTY) * self._typical * grid.polynomials_by_lag
        return out.field(_log_prior(grid, prior))

    @cached_property
    def _tiles(self) -> Int:
        """Indices (T, m) of the nodes of T equal tiles that cover the chip except for a margin."""
        ny, nx = self.grid.shape
        my, mx = min(TILE, ny), min(TILE, nx)
        nodes = np.arange(ny * nx).reshape(ny, nx)
        corners = [(j, i) for j in range(0, ny - my + 1, my) for i in range(0, nx - mx + 1, mx)]
        return np.array([nodes[j : j + my, i : i + mx].ravel() for j, i in corners])

    @cached_property
    def _tile_parts(self) -> tuple[Int, list[Float], Float]:
        """Lag indices (m, m) in a tile, B (m, m) of each tile, and their rough values (T, m)."""
        tiles = self._tiles
        lag = self.grid.lag[np.ix_(tiles[0], tiles[0])]
        noise = [np.asfortranarray(self.noise[np.ix_(tile, tile)]) for tile in tiles]
        return lag, noise, self.rough[tiles]

    def at_tiles(self, prior: Matern) -> FittedField:
        """Approximate `at` by treating tiles as independent, at a hundredth of the cost."""
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
        constrained = noise < 100 * np.median(noise)
        excess = np.mean(self.rough[constrained] ** 2) - np.mean(noise[constrained])
        amplitude = np.sqrt(max(float(excess), 0.01 * float(np.mean(noise[constrained]))))
        return float(np.log(amplitude)), float(np.log(2 * np.sqrt(np.prod(self.grid.step))))


class _Parts:
    """Accumulates the log density and its derivatives over independent parts of a chip.

    With V = C + B and a = V^-1 d, the gradient is (a^T V_k a - tr V^-1 V_k) / 2, and the curvature
    is the average information a^T V_k V^-1 V_l a / 2 (Gilmour, Thompson and Cullis 1995).  Since
    C depends only on the lag between two nodes, the trace is a sum over lags.
    """

    def __init__(self, prior: Matern, grid: NodeGrid) -> None:
        self.prior = prior
        self.by_lag, self.slope_by_lag = prior.by_lag(grid.lags)
        self.value = 0.0
        self.slope, self.curvature = np.zeros(2), np.zeros((2, 2))
        self.weights = np.zeros(grid.n_nodes)  # sums of V^-1 over pairs of nodes with equal lag
        self.means: list[Float] = []

    def add(
        self, V: Float, bent: Callable[[Float], Float], noise: Float, rough: Float, lag: Int
    ) -> None:
        """Add a part of the chip.

        `V` (m, m) is the covariance C of its field and is overwritten; `noise` is B and `rough` are
        the rough values.  `bent` multiplies a vector by the derivative of C with respect to log
        length.  `lag` (m, m) are the lag indices.
        """
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
        self.curvature += 0.5 * moved @ np.array([_product(inverse, vector) for vector in moved]).T
        self.means.append(mean)

    def field(self, log_prior: tuple[float, Float, Float]) -> FittedField:
        """Fitted field; `log_prior` is the log prior, its gradient and curvature."""
        value, slope, curvature = log_prior
        informed = float(self.by_lag @ self.weights)
        likelihood_slope = self.slope - 0.5 * np.array(
            [2 * informed, self.slope_by_lag @ self.weights]
        )
        # the likelihood is a function of amplitude^2; second-derivative term of the logarithm
        curvature[0, 0] += max(0.0, -2 * likelihood_slope[0])
        return FittedField(
            self.prior,
            self.value + value,
            likelihood_slope + slope,
            self.curvature + curvature,
            np.concatenate(self.means),
            informed,
        )


def _bent(grid: NodeGrid, by_lag: Float, vector: Float) -> Float:
    """Multiply a vector by the field's covariance, given by lag, without the polynomials."""
    return grid.without_polynomials(by_lag[grid.lag] @ vector)


def _product(lower: Float, vector: Float) -> Float:
    """Multiply a vector by a symmetric matrix that is given by its lower triangle."""
    out: Float = scipy.linalg.blas.dsymv(1.0, lower, vector, lower=1)
    return out


def _log_prior(grid: NodeGrid, prior: Matern) -> tuple[float, Float, Float]:
    """Log prior density of log amplitude and log length, its gradient and curvature.

    The prior density of the amplitude is proportional to the amplitude.  This keeps the most
    probable value away from zero, where the errors would vanish (Chung et al. 2013, Psychometrika
    78, 685).  The prior of the length is centred on about two node distances; it matters only if
    there is hardly any pattern.
    """
    mean, sd = LOG_LENGTH
    step = float(np.sqrt(np.prod(grid.step)))
    off = (np.log(prior.length / step) - mean) / sd
    value = 2 * float(np.log(prior.amplitude)) - 0.5 * float(off**2)
    return value, np.array([2.0, -off / sd]), np.diag([0.0, sd**-2])


def fitted_field(evidence: Evidence, smoothness: Sequence[float], *, thorough: bool) -> FittedField:
    """Find the most probable amplitude and length, and the best of the given `smoothness` values.

    The search uses tiles.  If `thorough` is True, it continues on the entire chip from there.
    """
    starts = [evidence.at_tiles(_prior_at(evidence.start, nu)) for nu in smoothness]
    tiles = [_summit(evidence, evidence.at_tiles, start) for start in starts]
    best = max(fit.log_evidence for fit in tiles)
    likely = [fit for fit in tiles if fit.log_evidence > best - RULED_OUT]
    if not thorough:
        return evidence.at(max(likely, key=lambda fit: fit.log_evidence).prior)
    candidates = sorted(
        (evidence.at(fit.prior) for fit in likely), key=lambda fit: -fit.log_evidence
    )
    best_fit = _summit(evidence, evidence.at, candidates[0])
    alternatives = (
        _summit(evidence, evidence.at, fit, best_fit.log_evidence) for fit in candidates[1:]
    )
    return max((best_fit, *alternatives), key=lambda fit: fit.log_evidence)


def _prior_at(point: Sequence[float] | Float, nu: float) -> Matern:
    """Matern field from log amplitude and log length."""
    amplitude, length = np.exp(point)
    return Matern(float(amplitude), float(length), nu)


def _bounds(evidence: Evidence) -> tuple[Float, Float]:
    """Lower and upper bounds of log amplitude and log length, wider than a grid can constrain."""
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
    """Find the most probable amplitude and length for one smoothness by a quasi-Newton search.

    The search starts from `here`.  The curvature is updated with the change of the gradient along
    the last step.  The search stops early if it cannot reach the log density `best`.
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
        candidate = density(_prior_at(here.point + step, here.prior.smoothness))
        change = here.slope - candidate.slope
        if candidate.log_evidence > here.log_evidence:
            here, longest = candidate, 1.0
        else:
            longest = 0.5 * float(np.abs(step).max())
        curvature = _corrected(here.curvature, step, change)
    return here


def _step(curvature: Float, slope: Float, low: Float, high: Float) -> Float:
    """Newton step (2,) that maximises the quadratic model within bounds."""
    root = np.linalg.cholesky(curvature)
    target = scipy.linalg.solve_triangular(root, slope, lower=True)
    optimum = scipy.optimize.lsq_linear(root.T, target, (low, high), method="bvls")
    return np.asarray(optimum.x, float)


def _corrected(curvature: Float, step: Float, change: Float) -> Float:
    """BFGS update of the curvature (2, 2); unchanged if the density is not concave on the step.

    `change` is the decrease of the gradient along `step`.
    """
    if change @ step <= 0:
        return curvature
    along = curvature @ step
    return (
        curvature
        - np.outer(along, along) / (step @ along)
        + np.outer(change, change) / (change @ step)
    )
