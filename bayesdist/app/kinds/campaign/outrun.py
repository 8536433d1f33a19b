"""Stars that have moved off a catalogue without proper motions, as the residuals show it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.kinds.campaign.inputs import Inputs
from bayesdist.data import Matches
from bayesdist.errors import InputError
from bayesdist.infer import LinearFit, residuals

__all__ = ["refuse_outrun_stars"]

Float = NDArray[np.float64]

MIN_SCATTER_RATIO = 2.0  # ratio of scatters beyond which centroids are not what most of it is
MIN_EXPLAINED = 0.5  # fraction of the variance of the scatters that the dates must explain
MIN_EXPOSURES = 5  # exposures: a parabola in time takes three
SIGMA_OF_MEDIAN = 1.4826  # of the median of |z|


def refuse_outrun_stars(inputs: Inputs, fit: LinearFit, pairs: Matches) -> None:
    """Refuse a catalogue without motions where residuals grow with the time from its epoch.

    The square of the residuals of stars that move is a parabola in time.

    Parameters
    ----------
    inputs : Inputs
    fit : LinearFit
        Of every exposure by itself.
    pairs : Matches
        What it was made from.

    Raises
    ------
    InputError
        Naming the catalogue.
    """
    if inputs.catalog.pm_u is not None or pairs.epoch is None:
        return
    size = np.abs(residuals(fit, pairs))
    names = range(len(pairs.exposure_names))
    rows = [np.flatnonzero(pairs.exposure == k) for k in names]
    rows = [one for one in rows if len(one)]
    if len(rows) < MIN_EXPOSURES:
        return
    date = np.array([pairs.epoch[one[0]] for one in rows])
    scatter = np.array([SIGMA_OF_MEDIAN * np.median(size[one]) for one in rows])
    if np.ptp(date) == 0 or scatter.max() < MIN_SCATTER_RATIO * scatter.min():
        return
    at = (date - date.mean()) / np.ptp(date)
    curve = np.polynomial.Polynomial.fit(at, scatter**2, 2).convert()
    left = np.var(scatter**2 - curve(at)) / np.var(scatter**2)
    if left > 1.0 - MIN_EXPLAINED or curve.coef[2] <= 0:
        return
    low, high = int(np.argmin(scatter)), int(np.argmax(scatter))
    raise InputError(
        f"has no proper motions, and the exposures span {np.ptp(date):.1f} years: residuals "
        f"scatter by {scatter[low]:.2g} {fit.unit} in {date[low]:.1f} and by {scatter[high]:.2g} "
        f"{fit.unit} in {date[high]:.1f}",
        where=inputs.catalog.source,
        do="give it columns pm_u and pm_v, or calibrate exposures of one epoch",
    )
