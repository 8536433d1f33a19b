"""Simulated input of the bring-up of a calibration: unmatched star lists, and an optical model.

The invented optical model is similar to the one in the WISE report.  Like the Code V model of the
report it resembles the true distortion if it is rotated by 270 degrees (WSDC D-T033, section 4:
longest vector 3.513 px, longest difference from W2 1.658 px).  Without the rotation it is worse
than no model (section 2).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayesdist.data.detections import Detections
from bayesdist.errors import InputError
from bayesdist.formats.sip.files import write_sip
from bayesdist.formats.sip.header import SipHeader
from bayesdist.missions.wise.published import WISE_ARRAYS
from bayesdist.missions.wise.simulate import wise_solution
from bayesdist.model import DistortionModel
from bayesdist.products.common.cards import text_card
from bayesdist.utils.arrays import Float, Int

__all__ = ["DELIVERED_TURN", "optical_model", "simulate_unpaired", "write_optical_model"]

MARGIN = 40.0  # margin of the reference catalogue around the detector, pixels
CENTROID = (0.05, 0.20)  # centroid errors of the brightest and the faintest detection, pixels
REFERENCE_SIGMA = 0.03  # errors of 2MASS, pixels (some 80 mas)

BAND = "W2"  # band for which the longest difference agrees with the report
DELIVERED_TURN = 270
QUARTERS = {0: 0, 90: 1, 180: 2, 270: 3}

# The model is the distortion plus a field that increases as the cube of the radius.  Its amplitude
# and its direction relative to the radius give, for W2, the two longest vectors of the report.
DIFFERENCE = 1.658  # pixels in the corners
DIRECTION = -1.12  # radians

HISTORY = (
    "An invented optical model, not the Code V model of WISE, which has not",
    "been published. It is the distortion of W2 plus a cubic field, so that",
    "its longest vector, and its longest difference from W2, are those of",
    "WSDC D-T033. It must be rotated by 270 degrees to fit.",
)


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


def optical_model(band: str = "W2", turn: int = 270) -> tuple[DistortionModel, Float]:
    """Optical model that resembles the true distortion after a rotation.

    Parameters
    ----------
    band : str
        'W1' to 'W4'.
    turn : int
        Rotation in degrees, from x towards y, that the model needs to fit: 0, 90, 180 or 270.  270
        is the model as delivered, and 0 the model after the rotation.

    Returns
    -------
    model : DistortionModel
    theta : ndarray, shape (D,)
        Parameters without constant terms.

    Raises
    ------
    InputError
        If the angle or the band is invalid.
    """
    if turn not in QUARTERS:
        raise InputError(
            f"the optical model is rotated by {turn} degrees",
            where="turn",
            do="choose 0, 90, 180 or 270",
        )
    model, truth = wise_solution(band)
    basis = model.basis()
    half = basis.half_size
    none, cubic = np.zeros((2, 2, basis.n_terms))
    none[:, 0], none[:, 1:3] = model.chips[0].reference_pixel, np.eye(2)
    for axis, terms in enumerate((((3, 0), (1, 2)), ((2, 1), (0, 3)))):
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
    """Field (2, K) of Legendre products over a square, rotated by -90 degrees."""
    at_rotated = np.empty_like(field)  # at the position (-y, x)
    for k, (i, j) in enumerate(terms):
        at_rotated[:, terms.index((j, i))] = (-1) ** i * field[:, k]
    return np.stack([at_rotated[1], -at_rotated[0]])


def write_optical_model(path: Path) -> None:
    """Write the model as delivered; rotated by 270 degrees it resembles all bands."""
    model, theta = optical_model(BAND, DELIVERED_TURN)
    array, basis = WISE_ARRAYS[BAND], model.basis()
    forward = basis.to_monomials(theta.reshape(2, -1))
    forward[:, 1:3] -= np.eye(2)
    forward[:, 0] = 0.0  # rounding errors at the reference pixel
    a, b = (
        dict(zip(basis.terms, map(float, coefficients), strict=True)) for coefficients in forward
    )
    nx, ny = array.size
    sip = SipHeader(
        crpix=array.centre,
        crval=(0.0, 0.0),
        cd=np.diag([-1.0, 1.0]) * array.scale / 3600,
        ctype=("RA---TAN-SIP", "DEC--TAN-SIP"),
        order=(model.order, model.order),
        a=a,
        b=b,
        size=(int(nx), int(ny)),
        cards=tuple(text_card("HISTORY", line) for line in HISTORY),
    )
    write_sip(sip, path)
