"""Simulated unmatched star lists, for the bring-up of a calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.data.detections import Detections
from bayesdist.errors import InputError
from bayesdist.missions.wise.simulate import wise_solution
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int

__all__ = ["simulate_unpaired"]

MARGIN = 40.0  # margin of the reference catalogue around the detector, pixels
CENTROID = (0.05, 0.20)  # centroid errors of the brightest and the faintest detection, pixels
REFERENCE_SIGMA = 0.03  # errors of 2MASS, pixels (some 80 mas)


@dataclass(frozen=True, eq=False)
class UnpairedStars:
    """Detections, reference stars, and their truth."""

    detections: Detections  # on the detector, pixels; the exposures are the frames
    reference: Detections  # undistorted positions in the frames, pixels
    partner: Int  # (N,), row of the reference star of each detection; -1 if there is none
    model: DistortionModel
    theta: Float  # (D,), the true distortion


def simulate_unpaired(
    n_frames: int = 40,
    *,
    rng: np.random.Generator,
    band: str = "W2",
    per_frame: float = 600.0,
    density: float = 1e-3,
    common: float = 0.8,
) -> UnpairedStars:
    """Simulate unmatched star lists of many frames.

    As with real data, false pairs are due to reference stars that are close to a detection by
    chance.

    Parameters
    ----------
    n_frames : int
        Number of frames.
    rng : numpy.random.Generator
    band : str
        'W1' to 'W4'.
    per_frame : float
        Mean number of detections per frame.
    density : float
        Number of undetected reference stars per square pixel of the undistorted frame.
    common : float
        Fraction of the detections that are in the reference catalogue.

    Returns
    -------
    UnpairedStars

    Raises
    ------
    InputError
        If the band is unknown, or the fraction is not from 0 to 1.
    """
    if not 0 <= common <= 1:
        raise InputError(
            f"the fraction of common stars is {common}", do="give a number from 0 to 1"
        )
    model, theta = wise_solution(band)
    nx, ny = model.chips[0].size
    n = int(rng.poisson(per_frame * n_frames))
    x, y = 0.5 + nx * rng.uniform(size=n), 0.5 + ny * rng.uniform(size=n)
    frame = rng.integers(n_frames, size=n)
    low, high = CENTROID
    sigma = low * (high / low) ** np.sqrt(rng.uniform(size=n))  # more faint stars than bright ones
    true = model.predict(theta, x, y)
    has = rng.uniform(size=n) < common
    matched_positions = true[has] + np.hypot(sigma[has], REFERENCE_SIGMA)[
        :, None
    ] * rng.standard_normal((int(has.sum()), 2))
    area = (nx + 2 * MARGIN) * (ny + 2 * MARGIN)
    m = int(rng.poisson(density * area * n_frames))
    undetected = rng.uniform(
        [0.5 - MARGIN] * 2, [nx + 0.5 + MARGIN, ny + 0.5 + MARGIN], size=(m, 2)
    )
    points = np.concatenate([matched_positions, undetected])
    frames = np.concatenate([frame[has], rng.integers(n_frames, size=m)])
    shuffled = rng.permutation(len(points))
    partner = np.full(n, -1, np.int64)
    partner[has] = np.argsort(shuffled)[: len(matched_positions)]
    names = tuple(map(str, range(n_frames)))
    return UnpairedStars(
        detections=Detections(x, y, frame, names, sigma=sigma),
        reference=Detections(
            points[shuffled, 0],
            points[shuffled, 1],
            frames[shuffled],
            names,
            sigma=np.full(len(points), REFERENCE_SIGMA),
        ),
        partner=partner,
        model=model,
        theta=theta,
    )
