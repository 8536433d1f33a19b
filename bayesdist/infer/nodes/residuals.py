"""Matches at pixels corrected by look-up tables, and residuals converted to pixel shifts.

The outlier mixture of `bayesdist.infer.stars.likelihood`, with its priors, is fitted by EM.  It
uses residuals only, so that polynomial and tables can be fitted alternately with its weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from bayesdist.data.matches import Matches
from bayesdist.errors import DegenerateError
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.stars.likelihood import (
    OUTLIER_MODE,
    OUTLIER_SHAPE,
    OutlierMixture,
    good_probability,
)
from bayesdist.infer.stars.stars import errors_of, groups_of
from bayesdist.model import DistortionModel
from bayesdist.model.lookup import LookupTable, corrected
from bayesdist.utils.arrays import Bool, Float

FOLDED = 1e-6  # determinant of the Jacobian over its squared norm, below which it is singular

SAMPLE = 200_000  # number of stars used to estimate fraction, jitter and outlier scale
STEPS = 200  # maximum number of EM iterations
WIDER = 3.0  # smallest ratio of the standard deviation of false matches to that of true ones
CONVERGED = 1e-3  # relative change of the expected number of false matches


@dataclass(frozen=True, eq=False)
class PixelShifts:
    """Residuals of matched stars in pixels of the detector.

    Parameters
    ----------
    shift : ndarray, shape (N, 2)
        Corrections to be added to x and y, in pixels.
    variance : ndarray, shape (N, 2)
        Variances of the shifts from the quoted errors, in square pixels. Correlations between x and
        y are not needed: tables of both are fitted separately.
    """

    shift: Float
    variance: Float


def pixel_shifts(solution: Solution, matches: Matches) -> PixelShifts:
    """Convert residuals in u, v to pixel shifts with the inverse of the local Jacobian.

    Parameters
    ----------
    solution : Solution
        Its mean is used.
    matches : Matches
        N stars with errors, in the unit of the solution.

    Returns
    -------
    PixelShifts
        Accurate to first order in the residual. The second-order term is below 1e-5 pixels for
        residuals of 0.2 pixels and the curvature of a wide-field camera.

    Raises
    ------
    InputError
        If the matches have no errors or another unit than the model.
    DegenerateError
        If the Jacobian of the polynomial is singular at a star.
    """
    sigma_u, sigma_v = errors_of(matches)
    model, groups = solution.model, groups_of(solution.model, matches)
    fitted, J = model.linearised(solution.mean, groups, matches.x, matches.y)
    det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    folded = np.abs(det) <= FOLDED * (J**2).sum(axis=(1, 2))
    if folded.any():
        k = int(np.argmax(folded))
        number = matches.chip_numbers[matches.chip[k]]
        raise DegenerateError(
            "the polynomial maps neighbouring pixels to one position",
            where=f"pixel ({matches.x[k]:.1f}, {matches.y[k]:.1f}) of chip {number}",
            do="check the match, or give a lower order",
        )
    inverse = np.empty_like(J)
    inverse[:, 0, 0], inverse[:, 1, 1] = J[:, 1, 1] / det, J[:, 0, 0] / det
    inverse[:, 0, 1], inverse[:, 1, 0] = -J[:, 0, 1] / det, -J[:, 1, 0] / det
    residual = np.stack([matches.u, matches.v], axis=1) - fitted
    shift = np.einsum("nab,nb->na", inverse, residual)
    if matches.rho_uv is not None:
        covariances = inverse @ matches.covariances() @ np.swapaxes(inverse, 1, 2)
        return PixelShifts(shift, np.einsum("naa->na", covariances))
    variance = np.stack([sigma_u, sigma_v], axis=1) ** 2
    return PixelShifts(shift, np.einsum("nab,nb->na", inverse**2, variance))


def corrected_matches(tables: Sequence[LookupTable], matches: Matches) -> Matches:
    """Apply look-up tables to the pixel coordinates of matches.

    Parameters
    ----------
    tables : sequence of LookupTable
        Tables of the detector and of at most one filter.
    matches : Matches
        Stars at raw pixel coordinates.

    Returns
    -------
    Matches
        The same stars at corrected pixel coordinates.
    """
    filter = next((table.filter for table in tables if table.filter), "")
    x, y = corrected(tables, matches.x, matches.y, chip=matches.chip_number, filter=filter)
    return matches.with_columns(x=x, y=y)


def on_the_chips(matches: Matches, model: DistortionModel) -> Matches:
    """Remove the few matches that a table has moved off their chip.

    The polynomial is not defined outside the chip; the tables still use these stars.

    Parameters
    ----------
    matches : Matches
        Stars at corrected pixel coordinates.
    model : DistortionModel

    Returns
    -------
    Matches
    """
    inside = inside_chips(matches, model)
    return matches if inside.all() else matches.select(inside, reason="moved off the chip")


def inside_chips(matches: Matches, model: DistortionModel) -> Bool:
    """Boolean mask that is True for matches on their chip.

    Parameters
    ----------
    matches : Matches
    model : DistortionModel

    Returns
    -------
    ndarray of bool, shape (N,)
    """
    size = np.array([model.chips[model.chip_code(c)].size for c in matches.chip_numbers])
    nx, ny = size[matches.chip].T
    x, y = matches.x, matches.y
    return np.asarray((x >= 0.5) & (x <= nx + 0.5) & (y >= 0.5) & (y <= ny + 0.5))


# -- outlier mixture of given residuals: membership probabilities and jitter -----------------------


@dataclass(frozen=True, eq=False)
class ResidualMixture:
    """Outlier mixture of residuals, with the probability that each star is a true match.

    Parameters
    ----------
    probability : ndarray, shape (N,)
        Probability that each star is a true match.
    fraction : float
        Fraction of false matches.
    jitter : float
        Additional error in excess of the quoted one, in the unit of the residuals.
    outlier_scale : float
        Standard deviation of false matches per axis, in the unit of the residuals.
    """

    probability: Float
    fraction: float
    jitter: float
    outlier_scale: float


def fit_mixture(residual: Float, variance: Float) -> ResidualMixture:
    """Fit the outlier mixture to residuals by EM.

    Parameters
    ----------
    residual : ndarray, shape (N, 2)
        Residuals along both axes.
    variance : ndarray, shape (N, 2)
        Squares of the quoted errors.

    Returns
    -------
    ResidualMixture
        Most probable values, and the membership probabilities for them.
    """
    stride = max(1, len(residual) // SAMPLE)
    sample, var = residual[::stride], variance[::stride]
    a, b = OutlierMixture().fraction_prior
    scale2 = float(np.median(var))
    rate = OUTLIER_SHAPE * OUTLIER_MODE**2 * scale2
    r2 = (sample**2).sum(axis=1)

    robust_variance = float(np.median(r2)) / (
        2 * np.log(2)
    )  # for a round Gaussian, insensitive to outliers
    f, j2, out2 = (
        0.05,
        max(robust_variance - scale2, 0.0),
        OUTLIER_MODE**2 * max(robust_variance, scale2),
    )
    before = np.inf
    for _ in range(STEPS):
        p = _true(sample, var, f, j2, out2)
        false = float((1 - p).sum())
        f = (false + a) / (len(sample) + a + b)
        j2, _ = jitter_variance(sample, var, p, 0.0)
        out2 = (0.5 * float((r2 * (1 - p)).sum()) + rate) / (false + OUTLIER_SHAPE)
        # If the quoted errors are too large, or the residuals still contain the pattern, a second
        # Gaussian of about the same width would fit the bulk better, and nearly all matches would
        # be declared false.
        out2 = max(out2, WIDER**2 * (scale2 + j2))
        if abs(false - before) < CONVERGED * (1.0 + false):
            break
        before = false
    return ResidualMixture(
        _true(residual, variance, f, j2, out2), f, float(np.sqrt(j2)), float(np.sqrt(out2))
    )


def _true(residual: Float, variance: Float, f: float, j2: float, out2: float) -> Float:
    """Probability (N,) that each star is a true match."""
    return good_probability((residual**2).T, (variance + j2).T, f, out2)


def jitter_variance(
    residual: Float, variance: Float, weight: Float, n_effective: float
) -> tuple[float, float]:
    """Most probable jitter variance, common to both axes, and its standard error.

    Parameters are the residuals (N, 2), their quoted variances (N, 2), the probabilities `weight`
    (N,) of true matches, and the effective number of fitted parameters of both axes together.  The
    jitter variance is 0 if the quoted errors are correct or too large.

    It is the zero of the derivative of the marginal likelihood.  The variance of the fitted values
    is distributed over the stars in proportion to their information, which is exact for equal
    errors.
    """
    w = np.broadcast_to(weight[:, None], residual.shape)
    free = 1.0 - min(n_effective / float(w.sum()), 0.99)

    def slope(j2: float) -> float:
        precision = 1.0 / (variance + j2)
        return float((w * (residual * precision) ** 2).sum() - free * (w * precision).sum())

    j2 = 0.0
    if slope(0.0) > 0:
        high = float((w * residual**2).sum() / w.sum()) / free
        while slope(high) > 0:
            high *= 2
        j2 = float(brentq(slope, 0.0, high, rtol=1e-6, xtol=1e-6 * high))
    information = 0.5 * free * float((w / (variance + j2) ** 2).sum())
    return j2, information**-0.5
