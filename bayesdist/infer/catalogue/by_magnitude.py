"""Joint estimate of the distortion and of the errors as a function of magnitude.

Stars are true matches with probability 1 - f, with errors that are a smooth function of magnitude
(`magnitude_law`); otherwise they are false matches from a wide normal distribution.  Distortion,
memberships and error law are updated in turn, each step increasing the same bound on the restricted
likelihood (variational EM).  The error law describes the residuals plus the part that the fit
absorbs, star by star.  Stars are not rejected by a limit, because stars that alternate between
rejected and accepted would make the errors oscillate.
"""

from __future__ import annotations

import numpy as np

from bayesdist.data.magnitude_errors import MagnitudeErrors, estimate
from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.catalogue.magnitude_law import MagnitudeLaw
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
from bayesdist.utils.arrays import Float
from bayesdist.utils.quantities import takes

STARS = 200_000  # sample size; it determines the error law to a part in a thousand
PER_EXPOSURE = 100  # the sample has on average at least this many stars per exposure and chip
SETTLED = 1e-3  # change of ln sigma below which the iteration has converged
TURNS = 200  # maximum number of iterations; far fewer are needed
FALSE = 0.02, 50.0  # prior of the fraction of false matches: mean, and weight in stars
WIDER = 10.0  # smallest ratio of the scatter of false matches to the largest error of true ones
LEAST_WEIGHT = 1e-9  # smallest weight of a star, to keep its error finite


@takes(matches=Matches, model=DistortionModel, rejection=Rejection, compute=Compute)
def fit_by_magnitude(
    matches: Matches,
    model: DistortionModel,
    *,
    rejection: Rejection = DEFAULT_REJECTION,
    priors: GaussianPriors | None = None,
    compute: Compute | None = None,
) -> tuple[LinearFit, Matches, MagnitudeErrors]:
    """Fit a distortion model and the errors as a function of magnitude simultaneously.

    Parameters
    ----------
    matches : Matches
        Stars with magnitudes; any errors in the table are replaced.
    model : DistortionModel
    rejection : Rejection
        See `fit_linear`.
    priors : GaussianPriors, optional
        See `fit_linear`.
    compute : Compute, optional
        See `fit_linear`.

    Returns
    -------
    fit : LinearFit
        Fit to all matches with the new errors.
    matches : Matches
        The matches with the new errors and without nominal positions. If a match circle truncates
        the residuals, the errors describe the truncated distribution, so that a correction for the
        circle must not be applied in addition.
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
    count = max(STARS, PER_EXPOSURE * len(model.exposures) * len(model.chips))
    errors = _law(matches.sample(count), model, rejection, priors)
    table = matches.without("u_nominal", "v_nominal").with_errors(errors)
    fit = fit_linear(table, model, rejection=rejection, priors=priors, compute=compute)
    return fit, table, errors


def _law(
    stars: Matches,
    model: DistortionModel,
    rejection: Rejection,
    priors: GaussianPriors | None,
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
    for _ in range(TURNS):
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
    """Fit stars with variances (2, N), weighted by the probabilities `good` (N,).

    Returns the fit and its residuals (2, N).
    """
    sigma_u, sigma_v = np.sqrt(variance) / np.sqrt(np.maximum(good, LEAST_WEIGHT))
    weighted = stars.with_errors((sigma_u, sigma_v))
    fit = fit_linear(weighted, model, rejection=NO_REJECTION, priors=priors)
    return fit, residuals_of(fit, stars)


def false_matches(good: Float, square: Float, least: float) -> tuple[float, float]:
    """Most probable fraction of false matches, and their variance per axis (at least `least`).

    `good` (N,) are the probabilities of true matches, `square` (2, N) the squared residuals.
    """
    bad = 1.0 - good
    fraction = float((bad.sum() + FALSE[0] * FALSE[1]) / (len(bad) + FALSE[1]))
    return fraction, max(least, float((bad * square).sum() / max(2.0 * bad.sum(), 1e-300)))


def residuals_of(fit: LinearFit, stars: Matches) -> Float:
    """Residuals (2, N): data minus model."""
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
