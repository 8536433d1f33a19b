"""Joint estimate of the distortion and of the errors as a function of magnitude.

Stars are true matches with probability 1 - f, with errors that are a smooth function of magnitude
(`magnitude_law`); otherwise they are false matches from a wide normal distribution.  Distortion,
memberships and error law are updated in turn, each step increasing the same bound on the restricted
likelihood (variational EM).  The error law describes the residuals plus the part that the fit
absorbs, star by star.  Stars are not rejected by a limit, because stars that alternate between
rejected and accepted would make the errors oscillate.

ln sigma is linear between nodes in magnitude.  Its changes of slope have a normal prior (integrated
Wiener process).  The scale of the prior is estimated from the scatter in bins by restricted
likelihood and then fixed, so that all later steps maximise the same function.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from bayesdist.data.magnitude_errors import MagnitudeErrors, estimate
from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.solution.linear import (
    DEFAULT_REJECTION,
    NO_REJECTION,
    LinearFit,
    Rejection,
    fit_linear,
)
from bayesdist.infer.stars.likelihood import good_probability
from bayesdist.infer.stars.shards import Compute
from bayesdist.infer.stars.stars import groups_of, in_table_order, prepare
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.quantities import takes

STARS = 200_000  # sample size; it determines the error law to a part in a thousand
PER_EXPOSURE = 100  # the sample has on average at least this many stars per exposure and chip
SETTLED = 1e-3  # change of ln sigma below which the iteration has converged
MAX_ITERATIONS = 200  # far fewer are needed
FALSE = 0.02, 50.0  # prior of the fraction of false matches: mean, and weight in stars
WIDER = 10.0  # smallest ratio of the scatter of false matches to the largest error of true ones
LEAST_WEIGHT = 1e-9  # smallest weight of a star, to keep its error finite

CELLS = 1000  # number of magnitude cells, small enough that the error is constant in each
LOG_VARIANCE = 1.36  # variance of ln(scatter) times n, for the median absolute deviation
BENDS = (1e-3, 1e2)  # limits of the prior scale of changes of slope over the range of magnitudes
ROOM = 2.0  # prior sigma of ln sigma about the scatter of the bins (a factor of 7)


@takes(matches=Matches, model=DistortionModel, rejection=Rejection, compute=Compute)
def fit_by_magnitude(
    matches: Matches,
    model: DistortionModel,
    *,
    rejection: Rejection = DEFAULT_REJECTION,
    priors: GaussianPriors | None = None,
    compute: Compute | None = None,
    max_iterations: int = MAX_ITERATIONS,
) -> tuple[LinearFit, Matches, MagnitudeErrors]:
    """Fit a distortion model and the errors as a function of magnitude simultaneously.

    Parameters
    ----------
    matches : Matches
        Stars with magnitudes; any errors in the table are replaced, and stars whose motion is
        assumed are left out.
    model : DistortionModel
    rejection : Rejection
        See `fit_linear`.
    priors : GaussianPriors, optional
        See `fit_linear`.
    compute : Compute, optional
        See `fit_linear`.
    max_iterations : int
        Maximum number of updates of distortion, memberships and error law.

    Returns
    -------
    fit : LinearFit
        Fit to all matches with the new errors.
    matches : Matches
        The matches in the fit with the new errors and without nominal positions. If a match circle
        truncates the residuals, the errors describe the truncated distribution, so that a
        correction for the circle must not be applied in addition.
    errors : MagnitudeErrors
        Error as a function of magnitude at its nodes, and the scatter near each node.

    Raises
    ------
    InputError
        If the table has no magnitudes, too few stars, or no scatter.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> rng = np.random.default_rng(1)
    >>> matches, truth = simulate_wise(500, rng=rng)
    >>> model = bd.build_model(matches, order=4, size=(1016, 1016))
    >>> fit, matches, errors = bd.fit_by_magnitude(matches, model)
    >>> bool((matches.sigma_u > 0).all())
    True
    """
    if not matches.has_mag:
        raise InputError(
            "errors by magnitude need magnitudes",
            where="data.columns",
            do="map column 'mag' or give data.sigma another value",
        )
    matches = matches.without_assumed_motions()
    count = max(STARS, PER_EXPOSURE * len(model.exposures) * len(model.chips))
    errors = _law(matches.sample(count), model, rejection, priors, max_iterations)
    table = matches.without("u_nominal", "v_nominal").with_errors(errors)
    fit = fit_linear(table, model, rejection=rejection, priors=priors, compute=compute)
    return fit, table, errors


def _law(
    stars: Matches,
    model: DistortionModel,
    rejection: Rejection,
    priors: GaussianPriors | None,
    max_iterations: int,
) -> MagnitudeErrors:
    """Estimate the errors as a function of magnitude from a sample of stars."""
    mag = stars.column("mag")
    fit = fit_linear(stars.with_errors(1.0), model, rejection=rejection, priors=priors)
    residual = residuals_of(fit, stars)
    bins = estimate(mag, *residual, n_params=model.n_params)
    law = MagnitudeLaw.of(mag, bins)
    nodes, square = law.start, residual**2
    narrowest = (WIDER * np.exp(nodes.max())) ** 2
    f, wide = FALSE[0], max(narrowest, float((square.sum(axis=0)).max()) / 8.0)
    for _ in range(max_iterations):
        var = law.at_stars(nodes)
        good = good_probability(square, var, f, wide)
        fit, residual = refitted(stars, model, var, good, priors)
        square = residual**2 + variances_of(fit, stars)
        f, wide = false_matches(good, square, narrowest)
        before, nodes = nodes, law.climbed(nodes, good, square)
        if np.abs(nodes - before).max() < SETTLED:
            break
    sigma_u, sigma_v = np.exp(nodes)
    scatter_u, scatter_v = _scatter(bins, mag, good, square)
    return MagnitudeErrors(bins.mag, sigma_u, sigma_v, bins.n, scatter_u, scatter_v)


def _scatter(bins: MagnitudeErrors, mag: Float, good: Float, square: Float) -> Float:
    """Rms error (2, B) per axis of the true matches nearest in magnitude to each of B nodes."""
    nearest = np.searchsorted((bins.mag[1:] + bins.mag[:-1]) / 2.0, mag)
    count = len(bins.mag)
    n = np.bincount(nearest, weights=good, minlength=count)
    sums = [np.bincount(nearest, weights=good * axis, minlength=count) for axis in square]
    return np.sqrt(np.array(sums) / np.maximum(n, 1e-300))


def refitted(
    stars: Matches,
    model: DistortionModel,
    variance: Float,
    good: Float,
    priors: GaussianPriors | None,
) -> tuple[LinearFit, Float]:
    """Fit stars with given variances (2, N), weighted by the probabilities `good` (N,).

    `good` are the probabilities of true matches.

    Returns the fit and its residuals (2, N), data minus model.
    """
    sigma_u, sigma_v = np.sqrt(variance) / np.sqrt(np.maximum(good, LEAST_WEIGHT))
    weighted = stars.with_errors((sigma_u, sigma_v))
    fit = fit_linear(weighted, model, rejection=NO_REJECTION, priors=priors)
    return fit, residuals_of(fit, stars)


def false_matches(good: Float, square: Float, least: float) -> tuple[float, float]:
    """Most probable fraction of false matches, and their variance per axis.

    `good` (N,) are the probabilities of true matches, `square` (2, N) the squared residuals, and
    `least` the smallest variance of false matches.
    """
    bad = 1.0 - good
    fraction = float((bad.sum() + FALSE[0] * FALSE[1]) / (len(bad) + FALSE[1]))
    return fraction, max(least, float((bad * square).sum() / max(2.0 * bad.sum(), 1e-300)))


def residuals_of(fit: LinearFit, stars: Matches) -> Float:
    """Residuals (2, N) of stars from a fit, data minus model, in the order of the table."""
    prepared, order = prepare(fit.model, stars.with_errors(1.0))
    return in_table_order(prepared.residuals(fit.mean), order).T


def variances_of(fit: LinearFit, stars: Matches) -> Float:
    """Variances (2, N) of the fitted positions of the stars, from the covariance of the fit."""
    model = fit.model
    groups = groups_of(model, stars)
    out = np.empty((2, len(stars)))
    jacobians = model.effective_jacobian(fit.mean, groups)
    for g, rows in enumerate(groups.members()):
        columns, d = jacobians[g]
        phi = model.basis(model.chips[groups.chip[g]].number).evaluate(stars.x[rows], stars.y[rows])
        cov = fit.cov[np.ix_(columns, columns)]
        for axis in (0, 1):
            out[axis, rows] = np.einsum("nk,nk->n", phi @ (d[axis] @ cov @ d[axis].T), phi)
    return out


# -- errors as a smooth function of magnitude, by penalised likelihood -----------------------------


@dataclass(frozen=True, eq=False)
class MagnitudeLaw:
    """Interpolation and prior of ln sigma at B nodes, for C cells of stars of similar magnitude."""

    cell: Int  # cell (N,) of each star
    design: Float  # linear interpolation (C, B) from the nodes to the cells
    # ln sigma (2, B) of u and v at the nodes from the scatter in bins; centre of a weak prior that
    # keeps sigma away from zero
    start: Float
    penalty: Float  # inverse covariance (B, B) of the smoothness prior

    @classmethod
    def of(cls, mag: Float, bins: MagnitudeErrors) -> MagnitudeLaw:
        """Law for stars with magnitudes (N,); the bins provide nodes and starting values."""
        count = min(len(mag), CELLS)
        rank = np.argsort(np.argsort(mag, kind="stable"), kind="stable")
        cell = rank * count // len(mag)
        size = np.bincount(cell, minlength=count)
        centre = np.bincount(cell, weights=mag, minlength=count) / size
        nodes = np.eye(len(bins.mag))
        design = np.stack([np.interp(centre, bins.mag, node) for node in nodes], axis=1)
        start = np.log(np.stack([bins.scatter_u, bins.scatter_v]))
        penalty = np.zeros_like(nodes)
        if len(bins.mag) > 2:
            bends = _bends(bins.mag)
            tau = _size_of_bends(start @ bends.T, bends, bins.n)
            penalty = bends.T @ bends / tau**2
        return cls(cell, design, start, penalty)

    def at_stars(self, nodes: Float) -> Float:
        """Squared errors (2, N) of the stars, from ln sigma (2, B) at the nodes of the law."""
        return np.asarray(np.exp(2.0 * nodes @ self.design.T)[:, self.cell])

    def climbed(self, nodes: Float, weight: Float, square: Float) -> Float:
        """Maximise the penalised likelihood; return ln sigma (2, B) at the nodes.

        `nodes` (2, B) is the starting point, `weight` (N,) the probability that a star is a true
        match, and `square` (2, N) its expected squared error.  The likelihood is concave, so that
        Newton's method with step halving finds its only maximum.
        """
        n = self._of_cells(weight)
        prior = self.penalty + np.eye(len(self.penalty)) / ROOM**2
        out = nodes.copy()
        for axis in (0, 1):
            s = self._of_cells(weight * square[axis])
            eta, value = out[axis], self._value(out[axis], axis, n, s)
            for _ in range(100):
                of_cells = s * np.exp(-2.0 * self.design @ eta)
                pull = self.penalty @ eta + (eta - self.start[axis]) / ROOM**2
                gradient = self.design.T @ (of_cells - n) - pull
                hessian = 2.0 * (self.design.T * of_cells) @ self.design + prior
                # limit the steps: far below the maximum the curvature grows exponentially
                step = np.linalg.solve(hessian, gradient)
                step *= min(1.0, 1.0 / max(np.abs(step).max(), 1e-300))
                new_value = self._value(eta + step, axis, n, s)
                while new_value < value and np.abs(step).max() > 1e-8:
                    step /= 2.0
                    new_value = self._value(eta + step, axis, n, s)
                if new_value >= value:
                    eta, value = eta + step, new_value
                if np.abs(step).max() < 1e-6:
                    break
            out[axis] = eta
        return out

    def _of_cells(self, values: Float) -> Float:
        sums = np.bincount(self.cell, weights=values, minlength=len(self.design))
        return np.asarray(sums, float)

    def _value(self, eta: Float, axis: int, n: Float, s: Float) -> float:
        of_cells, off = self.design @ eta, eta - self.start[axis]
        likelihood = -(n @ of_cells) - 0.5 * (s @ np.exp(-2.0 * of_cells))
        return float(likelihood - 0.5 * (eta @ self.penalty @ eta + off @ off / ROOM**2))


def _bends(mag: Float) -> Float:
    """Matrix (B - 2, B) of changes of slope at the inner nodes, with unit prior variance."""
    at = (mag - mag[0]) / (mag[-1] - mag[0])
    gap = np.diff(at)
    slopes = np.diff(np.eye(len(mag)), axis=0) / gap[:, None]
    return np.asarray(np.diff(slopes, axis=0) / np.sqrt((gap[1:] + gap[:-1])[:, None] / 2.0))


def _size_of_bends(found: Float, bends: Float, n: Int) -> float:
    """Most likely prior scale of the changes of slope `found`, given the noise of the bins."""
    noise = (bends * (LOG_VARIANCE / n)) @ bends.T

    def misfit(log_tau: float) -> float:
        cov = noise + np.exp(2.0 * log_tau) * np.eye(len(noise))
        whitened = np.linalg.solve(np.linalg.cholesky(cov), found.T)
        return float((whitened**2).sum() + len(found) * np.linalg.slogdet(cov)[1])

    limits = np.log(BENDS)
    return float(np.exp(minimize_scalar(misfit, bounds=limits, method="bounded").x))
