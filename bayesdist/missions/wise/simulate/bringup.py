"""First weeks of a calibration: unpaired lists of stars, and a poor initial distortion.

The distortion is WISE's of WSDC D-T033.  The initial one is an optical model like its Code V model:
turned by 270 degrees it resembles the truth (section 4: longest vector 3.513 px, longest difference
to W2 1.658 px); as delivered it is worse than none (section 2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import InputError
from bayesdist.missions.wise.frame_stars import FrameStars
from bayesdist.missions.wise.simulate import wise_solution
from bayesdist.model import DistortionModel

__all__ = ["UnpairedStars", "optical_model", "simulate_unpaired"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

# A field that grows as the cube of the radius, and its direction against the radius: with W2 these
# give the two longest vectors that the report prints.
DIFFERENCE = 1.658  # px in the corners
DIRECTION = -1.12  # radians

QUARTERS = {0: 0, 90: 1, 180: 2, 270: 3}
MARGIN = 40.0  # pixels by which the reference catalogue reaches beyond the detector
CENTROID = (0.05, 0.20)  # px, from the brightest to the faintest detection
REFERENCE_SIGMA = 0.03  # px: 2MASS, some 80 mas


def optical_model(band: str = "W2", turn: int = 270) -> tuple[DistortionModel, Float]:
    """Optical model that resembles the true distortion once it is turned.

    Parameters
    ----------
    band : str
    turn : int
        Degrees, from x towards y, by which it must be turned to fit: 0, 90, 180 or 270.  270 is the
        model as it was delivered, 0 the model already turned.

    Returns
    -------
    model : DistortionModel
    theta : ndarray, shape (D,)
        Its parameters, without constant terms.

    Raises
    ------
    InputError
        For another angle or an unknown band.
    """
    if turn not in QUARTERS:
        raise InputError(
            f"the optical model is turned by {turn} degrees",
            where="turn",
            do="choose 0, 90, 180 or 270",
        )
    model, truth = wise_solution(band)
    basis = model.basis()
    half = basis.half_size
    none = np.zeros((2, basis.n_terms))
    cubic = np.zeros((2, basis.n_terms))
    for axis, terms in enumerate((((3, 0), (1, 2)), ((2, 1), (0, 3)))):
        linear = basis.terms.index((1, 0) if axis == 0 else (0, 1))
        none[axis, [0, linear]] = model.chips[0].reference_pixel[axis], 1.0
        for i, j in terms:
            cubic[axis, basis.terms.index((i, j))] = half[0] ** -i * half[1] ** -j
    none, cubic = basis.from_monomials(none), basis.from_monomials(cubic)
    c, s = np.cos(DIRECTION), np.sin(DIRECTION)
    # in the corners x (x^2 + y^2) and y (x^2 + y^2) are 2, in units of the half size
    field = truth.reshape(2, -1) - none
    field[:, 0] -= field @ basis.monomial_matrix[0]
    field += DIFFERENCE / np.sqrt(8) * (np.array([[c, -s], [s, c]]) @ cubic)
    for _ in range(QUARTERS[turn]):
        field = _turned_back(field, basis.terms)
    return model, (none + field).ravel()


def _turned_back(field: Float, terms: tuple[tuple[int, int], ...]) -> Float:
    """Field (2, K) of Legendre products over a square, turned by -90 degrees."""
    there = np.empty_like(field)  # at the position (-y, x)
    for k, (i, j) in enumerate(terms):
        there[:, terms.index((j, i))] = (-1) ** i * field[:, k]
    return np.stack([there[1], -there[0]])


@dataclass(frozen=True, eq=False)
class UnpairedStars:
    """Detections, reference stars, and the truth about them.

    Parameters
    ----------
    detections : FrameStars
        On the detector, pixels.
    reference : FrameStars
        Undistorted positions in the frames, pixels.
    partner : ndarray of int, shape (N,)
        Row of each detection's own reference star; -1 where the catalogue has none.
    model : DistortionModel
    theta : ndarray, shape (D,)
        The true distortion.
    """

    detections: FrameStars
    reference: FrameStars
    partner: Int
    model: DistortionModel
    theta: Float


def simulate_unpaired(
    n_frames: int = 40,
    *,
    rng: np.random.Generator,
    band: str = "W2",
    per_frame: float = 600.0,
    density: float = 1e-3,
    common: float = 0.8,
) -> UnpairedStars:
    """Lists of stars of many frames, unpaired.

    False pairs come about as in the sky: by reference stars that happen to lie near a detection.

    Parameters
    ----------
    n_frames : int
    rng : numpy.random.Generator
    band : str
    per_frame : float
        Detections in a frame, in the mean.
    density : float
        Reference stars that were not detected, for each square pixel of the undistorted frame.
    common : float
        Fraction of the detections that the reference catalogue has, too.

    Returns
    -------
    UnpairedStars

    Raises
    ------
    InputError
        For an unknown band, or a fraction outside 0 to 1.
    """
    if not 0 <= common <= 1:
        raise InputError(f"the share of common stars is {common}", do="give one from 0 to 1")
    model, theta = wise_solution(band)
    nx, ny = model.chips[0].size
    n = int(rng.poisson(per_frame * n_frames))
    x, y = 0.5 + nx * rng.uniform(size=n), 0.5 + ny * rng.uniform(size=n)
    frame = rng.integers(n_frames, size=n)
    low, high = CENTROID
    sigma = low * (high / low) ** np.sqrt(rng.uniform(size=n))  # more faint stars than bright ones
    true = model.predict(theta, x, y)
    has = rng.uniform(size=n) < common
    seen = true[has] + np.hypot(sigma[has], REFERENCE_SIGMA)[:, None] * rng.standard_normal(
        (int(has.sum()), 2)
    )
    area = (nx + 2 * MARGIN) * (ny + 2 * MARGIN)
    m = int(rng.poisson(density * area * n_frames))
    others = rng.uniform([0.5 - MARGIN] * 2, [nx + 0.5 + MARGIN, ny + 0.5 + MARGIN], size=(m, 2))
    points = np.concatenate([seen, others])
    frames = np.concatenate([frame[has], rng.integers(n_frames, size=m)])
    shuffled = rng.permutation(len(points))
    partner = np.full(n, -1, np.int64)
    partner[has] = np.argsort(shuffled)[: len(seen)]
    return UnpairedStars(
        detections=FrameStars(x, y, sigma, frame),
        reference=FrameStars(
            points[shuffled, 0],
            points[shuffled, 1],
            np.full(len(points), REFERENCE_SIGMA),
            frames[shuffled],
        ),
        partner=partner,
        model=model,
        theta=theta,
    )
