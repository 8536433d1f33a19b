"""The detections of a self-calibration as pairs: each beside the place where its star was found.

So the usual statistics of residuals, maps of bins and diagrams serve self-calibrations too.  Stars
follow their detections: residuals are smaller than the errors by what that takes.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.kinds.selfcal.inputs import Inputs
from bayesdist.data import MagnitudeErrors, Matches
from bayesdist.data.detections import Detections
from bayesdist.infer.selfcal import SelfCalibrationMode
from bayesdist.infer.selfcal.calibrate import scatter_by_magnitude
from bayesdist.infer.selfcal.elimination import memberships
from bayesdist.infer.selfcal.problem import Problem

__all__ = ["magnitude_errors_of", "matches_of"]

Float = NDArray[np.float64]


def matches_of(
    problem: Problem,
    stars: Float,
    detections: Detections,
    inputs: Inputs,
    unused: Mapping[str, int],
) -> Matches:
    """Detections of the stars beside these, in the frame of each exposure's own VAFACTOR.

    Parameters
    ----------
    problem : Problem
        Linearised at a solution.
    stars : ndarray, shape (S, q)
        Of the solution.
    detections : Detections
        Of which the problem has some.
    inputs : Inputs
    unused : mapping of str to int
        Detections that are of no star, by reason.
    """
    p, d = problem, detections
    rows, model = p.rows, p.model
    places = p.star_places(stars)
    if p.dilation is not None:
        o = np.asarray(model.origin)
        places = o + (places - o) / p.dilation[d.exposure[rows], None]
    sigma = np.sqrt(p.var)[:, None] * _axes(p.W)
    numbers = np.array([chip.number for chip in model.chips])
    chip = np.zeros(len(rows), np.int64)
    for code, number in enumerate(numbers[1:], start=1):
        chip[d.chip[rows] == number] = code
    return Matches.of_distinct_rows(
        x=d.x[rows],
        y=d.y[rows],
        u=places[:, 0],
        v=places[:, 1],
        sigma_u=sigma[:, 0],
        sigma_v=sigma[:, 1],
        unit=model.unit,
        epoch=None if d.epoch is None else d.epoch[d.exposure[rows]],
        mag=None if d.mag is None else d.mag[rows],
        exposure=d.exposure[rows],
        exposure_names=d.exposure_names,
        chip=chip,
        chip_numbers=tuple(int(n) for n in numbers),
        row=rows,
        sources=(d.source,),
        n_rows=inputs.n_read,
        rejected={**inputs.rejected, **unused},
    )


def _axes(W: Float) -> Float:
    """Error along u and along v (N, 2) of a pixel of error: of W^-1."""
    det = W[:, 0] * W[:, 2] - W[:, 1] ** 2
    return np.sqrt(np.stack([W[:, 2], W[:, 0]], axis=1) / det[:, None])


def magnitude_errors_of(solution: SelfCalibrationMode, matches: Matches) -> MagnitudeErrors | None:
    """Errors of centroids by magnitude, in the unit of u, v; None without magnitudes."""
    if matches.mag is None:
        return None
    p = solution.problem
    given = p, solution.theta, solution.mixture, solution.stars
    middles, sigma = scatter_by_magnitude(*given, matches.mag)
    sigma = sigma * p.model.pixel_size(solution.theta)
    edges = np.concatenate([[-np.inf], (middles[1:] + middles[:-1]) / 2, [np.inf]])
    n = np.histogram(matches.mag, edges, weights=memberships(*given))[0]
    return MagnitudeErrors(middles, sigma, sigma, n.astype(np.int64), sigma, sigma)
