"""Scatter of residuals by magnitude: the error of the centroids, and whatever else they hold."""

from __future__ import annotations

import numpy as np

from bayesdist.data.magnitude_errors import MagnitudeErrors, estimate
from bayesdist.diagnose.residuals.sample import StarSample

__all__ = ["centroid_scatter"]

MIN_STARS = 50  # stars whose scatter says anything by magnitude
CERTAIN = 0.5  # probability of a false match from which on a star is left out


def centroid_scatter(stars: StarSample, *, n_params: int = 0) -> MagnitudeErrors | None:
    """Scatter of the residuals by magnitude.

    Of stars with a posterior the likely false matches are left out, else what the fit rejected;
    `n_params` are the parameters of the fit to all stars. None where the stars have no magnitudes,
    or too few of them.
    """
    mag = stars.table.mag
    if mag is None:
        return None
    good = np.isfinite(mag) & (
        stars.used if stars.outlier_probability is None else stars.outlier_probability < CERTAIN
    )
    if good.sum() < MIN_STARS:
        return None
    share = round(n_params * len(stars) / max(stars.n_total, 1))
    return estimate(mag[good], *stars.residual[good].T, n_params=share)
