"""WISE: matched pairs of band-frame and 2MASS positions, from the published distortion.

Coefficients are those of WSDC D-T033 ("WISE IOC Distortion Calibration"), Appendix B; the detector
and the reference pixel follow from its printed A_DMAX and B_DMAX, which are reached with u, v
within +-507.5 pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import MatchTable
from bayesdist.errors import InputError
from bayesdist.model import Chip, DistortionModel
from bayesdist.simulate.matches import Truth, simulate_matches

__all__ = ["WISE_COEFFICIENTS", "simulate_wise", "wise_solution"]

Float = NDArray[np.float64]

# band: (A, B), each in the order of polynomial_terms(4): 00, 10, 01, 20, 11, 02, 30, ...
# fmt: off
WISE_COEFFICIENTS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "W2": (
        (7.597772e-01, -5.040463e-04, -1.192789e-04, -1.349460e-06, 1.082862e-06, -8.064834e-06,
         2.959435e-09, -1.297961e-09, 3.389170e-10, -4.935791e-10,
         1.787756e-12, -6.743610e-13, 2.075723e-12, -5.769507e-13, -1.303108e-13),
        (-9.433609e-02, -2.026974e-04, 5.505028e-04, 8.038015e-08, -3.953933e-06, 1.091415e-06,
         1.067827e-10, 4.101600e-10, -9.316313e-10, -3.840921e-09,
         -1.788157e-13, 1.952342e-12, -5.705721e-13, 8.534495e-13, -5.181754e-13),
    ),
}
# fmt: on

SIZE = (1016.0, 1016.0)
CENTRE = (508.5, 508.5)
SCALE_MAS = 2750.0
FAINT, BRIGHT = 14.5, 7.0


def wise_solution(band: str = "W2") -> tuple[DistortionModel, Float]:
    """The published distortion of a band as a model and its parameters.

    Parameters
    ----------
    band : str

    Returns
    -------
    model : DistortionModel
        Order 4; u, v are distortion-free band-frame pixels.
    theta : ndarray, shape (30,)

    Raises
    ------
    InputError
        For a band whose coefficients are not held.
    """
    if band not in WISE_COEFFICIENTS:
        raise InputError(
            f"there is no band {band!r}", where="band", do=f"choose {', '.join(WISE_COEFFICIENTS)}"
        )
    model = DistortionModel(4, (Chip(1, band, SIZE, CENTRE),))
    terms = model.basis().terms
    theta = np.empty(model.n_params)
    for axis, sip in enumerate(WISE_COEFFICIENTS[band]):
        # SIP: the corrected offset from the reference pixel is the raw one plus the polynomial
        monomial = np.array(sip)
        monomial[0] += CENTRE[axis]
        monomial[terms.index((1, 0) if axis == 0 else (0, 1))] += 1.0
        theta[model.coefficient_slice(None, axis)] = model.basis().from_monomials(monomial)
    return model, theta


def _errors(mag: Float) -> tuple[Float, Float]:
    """Quoted error of a pair: a floor, and photon noise towards the faint end, in pixels."""
    sigma = np.hypot(0.03, 0.12 * 10 ** (0.3 * (mag - FAINT)))
    return sigma, 1.1 * sigma  # pairs are measured a little worse along the scan


def simulate_wise(
    n: int = 6000,
    *,
    band: str = "W2",
    rng: np.random.Generator,
    fraction: float = 0.03,
    jitter: float = 0.03,
    outlier_scale: float = 1.0,
) -> tuple[MatchTable, Truth]:
    """Pairs of WISE detections and 2MASS stars.

    Parameters
    ----------
    n : int
    band : str
    rng : numpy.random.Generator
    fraction : float
        Share of false matches.
    jitter : float
        Error beyond the quoted ones, in pixels: the partition of the point-spread function
        (section 5 of the report) leaves residuals of this size.
    outlier_scale : float
        Standard deviation of false matches on each axis, in pixels.

    Returns
    -------
    matches : MatchTable
    truth : Truth
    """
    model, theta = wise_solution(band)
    # star counts rise as 10^(0.3 m)
    p = rng.uniform(size=n)
    low, high = 10 ** (0.3 * BRIGHT), 10 ** (0.3 * FAINT)
    mag = np.log10(low + p * (high - low)) / 0.3
    return simulate_matches(
        model,
        theta,
        n,
        rng=rng,
        sigma=_errors,
        mag=mag,
        fraction=fraction,
        jitter=jitter,
        outlier_scale=outlier_scale,
    )
