"""Preparation of matches for the fit: errors of the centroids, and a scale without aberration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.exposures import ExposureLog
from bayesdist.data.magnitude_errors import MagnitudeErrors
from bayesdist.data.matches import Matches
from bayesdist.data.tables.checks import columns_of
from bayesdist.errors import InputError

__all__ = ["centroid_errors", "neutralise_aberration"]

Float = NDArray[np.float64]

# of the total scatter that is the centroid's, whatever the catalogue quotes
MIN_CENTROID_FRACTION = 0.25


def centroid_errors(table: Matches, total: MagnitudeErrors) -> MagnitudeErrors:
    """Errors of the centroids: scatter of the residuals less the errors of the catalogue.

    Parameters
    ----------
    table : Matches
        With magnitudes and the errors of the catalogue.
    total : MagnitudeErrors
        Scatter of its residuals.

    Returns
    -------
    MagnitudeErrors
        Total less catalogue (median of each bin's stars) in quadrature, at least a quarter of the
        total: the catalogue's quoted errors are not that well known.

    Raises
    ------
    InputError
        Without magnitudes or errors.
    """
    if table.mag is None or table.sigma_u is None or table.sigma_v is None:
        raise InputError(
            "has no magnitudes, or no errors of the catalogue",
            where=", ".join(table.sources),
            do="give lists with magnitudes and a catalogue with errors",
        )
    which = np.searchsorted((total.mag[1:] + total.mag[:-1]) / 2, table.mag)
    left = []
    for sigma, of_catalog in ((total.sigma_u, table.sigma_u), (total.sigma_v, table.sigma_v)):
        known = np.array(
            [
                np.median(of_catalog[which == k]) if (which == k).any() else 0.0
                for k in range(len(total.mag))
            ]
        )
        left.append(np.sqrt(np.maximum(sigma**2 - known**2, (MIN_CENTROID_FRACTION * sigma) ** 2)))
    return replace(total, sigma_u=left[0], sigma_v=left[1])


def neutralise_aberration(table: Matches, log: ExposureLog) -> Matches:
    """Matches with catalogue positions as an aberration-free scale gives them.

    A true offset on the sky is VAFACTOR times that by the aberration-free scale of the detector,
    so that positions and their errors are divided by it.  Any other origin would shift all stars of
    an exposure alike.

    Parameters
    ----------
    table : Matches
    log : ExposureLog
        With VAFACTOR of each exposure of the table.

    Returns
    -------
    Matches

    Raises
    ------
    InputError
        Naming the first exposure without VAFACTOR, or not in the log.
    """
    for name in table.exposures:
        if name not in log:
            raise InputError(f"has no exposure {name!r}", where=log.source, do="add it to the log")
    used = log.select(names=table.exposures)
    used.require("vafactor")
    factor = np.array(
        [used[name].vafactor if name in used else 1.0 for name in table.exposure_names], float
    )[table.exposure]
    lengths = ("u", "v", "sigma_u", "sigma_v", "u_nominal", "v_nominal")
    columns = columns_of(table, lengths)
    return table.with_columns(**{name: values / factor for name, values in columns.items()})
