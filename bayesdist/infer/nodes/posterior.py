"""Posterior of a look-up table: node values, covariance, and hyperparameters of their Matern field.

With the polynomial integrated out (REML), the stars give a rough estimate d = B b of the node
values on each axis, with covariance B about the true values.  The true values are a field with
covariance C, so d is Gaussian with covariance C + B.  Each set of hyperparameters therefore needs
one Cholesky factorisation, independent of the number of stars.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import scipy.linalg
import scipy.optimize
from numpy.typing import ArrayLike
from scipy.sparse.linalg import LinearOperator, cg

from bayesdist.infer.kernel.blocks import at_once
from bayesdist.infer.kernel.lapack import cholesky, divided, inverse_of
from bayesdist.infer.nodes.grid import NodeGrid, NodeSums
from bayesdist.model.lookup import LookupTable
from bayesdist.utils.arrays import Float, Int

BLOCK = 2048  # pixels processed at a time, with dense rows over all nodes
COLUMNS = 512  # block size for computing only one triangle of a symmetric product
SOLVED = 1e-10  # relative tolerance of node values that are updated for new weights of the stars


@dataclass(frozen=True, eq=False)
class NodeCovariance:
    """Posterior covariance of the node values of one axis, with the polynomial integrated out."""

    grid: NodeGrid
    sums: NodeSums  # normal equations of the stars
    prior: Matern

    @cached_property
    def root(self) -> Float:
        """Matrix R (n, n) such that R R^T is the covariance.

        With d = L z, z ~ N(0, 1), and L the polynomial-free part of the Cholesky factor of the
        prior, the precision of z is 1 + L^T A L.  It is never singular, even with empty bins.
        """
        L = self.grid.without_polynomials(cholesky(self.prior.covariance(self.grid)))
        informed = self.sums.informed(L)
        M = np.zeros(L.shape)
        for start in range(0, len(L), COLUMNS):
            M[start : start + COLUMNS, start:] = (
                L[:, start : start + COLUMNS].T @ informed[:, start:]
            )
        M[np.diag_indices_from(M)] += 1.0
        # R^T = K^-1 L^T with K K^T = M
        root = divided(cholesky(M), np.asfortranarray(L.T)).T
        # the factor of the prior has relative rounding errors of 1e-16 in the polynomial space
        return self.grid.without_polynomials(root)

    def mean(self, sums: NodeSums) -> Float | None:
        """Node values (n,) for slightly different sums; None if they differ too much.

        With d = R z, the precision of z is 1 + R^T dA R, where dA is the change of the information.
        It is close to the identity, so that conjugate gradients need only a few products with R.
        """
        R = self.root

        def precision(z: Float) -> Float:
            d = R @ z
            return z + R.T @ (sums.informed(d) - self.sums.informed(d))

        right = R.T @ sums.marginal_right
        z, unsolved = cg(LinearOperator(R.shape, precision, dtype=float), right, right, rtol=SOLVED)
        return None if unsolved else R @ z


@dataclass(frozen=True, eq=False)
class AxisField:
    """Gaussian posterior of the node values of one axis, with the polynomial integrated out.

    Parameters
    ----------
    covariance : NodeCovariance
    field : FittedField
        Hyperparameters and their log density.
    mean : ndarray, shape (n,)
        Node values in pixels.
    n_effective : float
        Effective number of fitted parameters (nodes and polynomial).
    """

    covariance: NodeCovariance
    field: FittedField
    mean: Float
    n_effective: float

    @classmethod
    def of(cls, evidence: Evidence, field: FittedField) -> AxisField:
        """Posterior with the hyperparameters of `field`, which was fitted to the same stars."""
        sums = evidence.sums
        n = len(sums.polynomial) + field.n_effective
        return cls(NodeCovariance(evidence.grid, sums, field.prior), field, field.mean, n)

    def at_same_prior(self, sums: NodeSums) -> AxisField:
        """Posterior from other sums with the same hyperparameters."""
        evidence = Evidence(self.covariance.grid, sums)
        return AxisField.of(evidence, evidence.at(self.field.prior))

    def following(self, sums: NodeSums) -> AxisField:
        """Posterior from slightly different sums with the same hyperparameters.

        Only the mean is updated; the covariance is kept, since the weights of the stars change by
        about a part in a thousand.
        """
        mean = self.covariance.mean(sums)
        return self.at_same_prior(sums) if mean is None else replace(self, mean=mean)

    @property
    def sums(self) -> NodeSums:
        """Normal equations from which the covariance was computed."""
        return self.covariance.sums

    @property
    def root(self) -> Float:
        """Matrix R (n, n) such that R R^T is the covariance."""
        return self.covariance.root

    @property
    def sigma(self) -> Float:
        """Standard error (n,) of each node in pixels."""
        return np.sqrt(np.einsum("ij,ij->i", self.root, self.root))

    @property
    def cov(self) -> Float:
        """Covariance (n, n) of the node values in square pixels."""
        return self.root @ self.root.T

    def gain(self, rows: Float) -> Float:
        """Part of the errors of an underlying table that this table absorbs.

        `rows` (N, n) are derivatives with respect to the node values.  Returns rows S A (N, n),
        with the covariance S of this table and the information A of the stars.
        """
        return self.sums.informed(self.root @ (self.root.T @ rows.T)).T


@dataclass(frozen=True, eq=False)
class TablePosterior:
    """Posterior of one look-up table; its two axes are independent.

    Parameters
    ----------
    grid : NodeGrid
    axes : tuple of AxisField
        Posteriors of the x and y planes.
    filter : str
        Filter of the table; '' for the detector's table.
    jitter : float
        Additional error of the stars in excess of the quoted errors, in pixels.
    jitter_sigma : float
        Standard error of the jitter in pixels.
    n_stars : float
        Sum of the weights of the stars.
    """

    grid: NodeGrid
    axes: tuple[AxisField, AxisField]
    filter: str
    jitter: float
    jitter_sigma: float
    n_stars: float

    @property
    def means(self) -> LookupTable:
        """Table of the posterior means, without errors, which take time (see `table`)."""
        return self.grid.table(np.stack([axis.mean for axis in self.axes]), filter=self.filter)

    @cached_property
    def table(self) -> LookupTable:
        """Table of the posterior means, with the standard error of each node."""
        sigma = np.stack(at_once(lambda axis: axis.sigma, self.axes))
        return replace(self.means, sigma=sigma.reshape(2, *self.grid.shape))

    @property
    def priors(self) -> tuple[Matern, Matern]:
        """Hyperparameters of the x and y planes."""
        return self.axes[0].field.prior, self.axes[1].field.prior

    @property
    def cov(self) -> Float:
        """Covariance (2, n_nodes, n_nodes) of the node values in square pixels."""
        return np.stack([axis.cov for axis in self.axes])

    def position_sigma(self, x: ArrayLike, y: ArrayLike, *, refitted: bool = False) -> Float:
        """Standard error of the interpolated shift.

        Parameters
        ----------
        x, y : array_like, shape (N,)
            Raw pixel coordinates.
        refitted : bool
            True for the error that remains after the polynomial is refitted to compensate errors
            of the table. Added in quadrature to the formal error of a polynomial that was fitted
            with the table fixed, it gives exactly the total error.

        Returns
        -------
        ndarray, shape (N, 2)
            Standard errors along x and y in pixels.
        """
        x, y = (np.atleast_1d(np.asarray(p, float)) for p in (x, y))
        out = np.empty((len(x), 2))
        for start in range(0, len(x), BLOCK):
            rows = slice(start, start + BLOCK)
            weights = self.grid.interpolation(x[rows], y[rows])
            phi = self.grid.basis.evaluate(x[rows], y[rows])
            for a, axis in enumerate(self.axes):
                response = weights @ axis.root
                if refitted:
                    response -= phi @ (axis.sums.absorbed @ axis.root)
                out[rows, a] = np.linalg.norm(response, axis=1)
        return out

    def rows(self, x: Float, y: Float, axis: int, *, refitted: bool = False) -> Float:
        """Derivatives of the interpolated shift along an axis with respect to the node values.

        Parameters
        ----------
        x, y : ndarray, shape (N,)
            Raw pixel coordinates.
        axis : int
            0 for x, 1 for y.
        refitted : bool
            See `position_sigma`.

        Returns
        -------
        ndarray, shape (N, n_nodes)
        """
        out: Float = self.grid.interpolation(x, y).toarray()
        if refitted:
            out -= self.grid.basis.evaluate(x, y) @ self.axes[axis].sums.absorbed
        return out


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
