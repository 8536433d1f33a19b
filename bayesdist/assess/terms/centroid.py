"""Errors of centroids by magnitude: what the scatter of residuals is beside what else is in it.

The residual of a star holds the error of its centroid, that of the reference star, and whatever the
model leaves out.  A budget that lists the reference catalogue and the residual scatter beside each
other counts the catalogue twice: what is known to be in the residuals is taken off first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bayesdist.data.magnitude_errors import MagnitudeErrors, estimate
from bayesdist.data.preparing import MIN_CENTROID_FRACTION
from bayesdist.diagnose.residuals.sample import StarSample
from bayesdist.errors import InputError

__all__ = ["centroid_scatter", "without"]

FEWEST = 50  # stars whose scatter says anything by magnitude
CERTAIN = 0.5  # probability of a false match from which on a star is left out


def centroid_scatter(
    stars: StarSample, contained: Sequence[tuple[str, float, float]] = (), *, n_params: int = 0
) -> MagnitudeErrors | None:
    """Scatter of the residuals by magnitude, less other errors that are in it.

    Parameters
    ----------
    stars : StarSample
        With a posterior its likely false matches are left out, else what the fit rejected.
    contained : sequence of (name, sigma_u, sigma_v)
        Errors that the residuals hold beside those of the centroids, in their unit.
    n_params : int
        Parameters of the fit, for all stars there are.

    Returns
    -------
    MagnitudeErrors or None
        At least a quarter of the scatter: the other errors are not that well known.  None where the
        stars have no magnitudes, or too few of them.

    Raises
    ------
    InputError
        Where an error that is said to be in the residuals is larger than these.
    """
    mag = stars.table.mag
    if mag is None:
        return None
    good = np.isfinite(mag) & (
        stars.used if stars.outlier_probability is None else stars.outlier_probability < CERTAIN
    )
    if good.sum() < FEWEST:
        return None
    share = round(n_params * len(stars) / max(stars.n_total, 1))
    total = estimate(mag[good], *stars.residual[good].T, n_params=share)
    left = {}
    for axis, name in ((1, "sigma_u"), (2, "sigma_v")):
        sigma = getattr(total, name)
        known = np.sqrt(sum(one[axis] ** 2 for one in contained))
        # the median of n absolute residuals is known to 1.17 / sqrt(n)
        too_small = sigma * (1.0 + 3.0 * 1.17 / np.sqrt(total.n)) < known
        if too_small.any():
            k = int(np.argmax(too_small))
            raise InputError(
                f"errors of {known:.3g} are said to be in residuals that scatter by "
                f"{sigma[k]:.3g} at magnitude {total.mag[k]:.2f}",
                where=f"budget term {contained[0][0]!r}",
                do="correct them, or set included_in_scatter = false",
            )
        left[name] = known
    return without(total, left["sigma_u"], left["sigma_v"])


def without(errors: MagnitudeErrors, sigma_u: float, sigma_v: float) -> MagnitudeErrors:
    """Errors by magnitude, less an error that all of them hold.

    Parameters
    ----------
    errors : MagnitudeErrors
    sigma_u, sigma_v : float
        In their unit.

    Returns
    -------
    MagnitudeErrors
        At least a quarter of what they were.
    """
    left = {
        name: np.sqrt(np.maximum(sigma**2 - known**2, (MIN_CENTROID_FRACTION * sigma) ** 2))
        for name, sigma, known in (
            ("sigma_u", errors.sigma_u, sigma_u),
            ("sigma_v", errors.sigma_v, sigma_v),
        )
    }
    return replace(errors, **left)
