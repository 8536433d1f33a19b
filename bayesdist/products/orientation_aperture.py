"""The orientation of a solution from an aperture of the Science Instrument Aperture File."""

from __future__ import annotations

import numpy as np

from bayesdist.assess.solution import Solution, place_of
from bayesdist.errors import InputError
from bayesdist.products.formats.idctab.hst import parity_of
from bayesdist.products.orientation import (
    Orientation,
    check_epoch,
    check_frames,
    cov_about,
    held_scale,
    mirrored,
)
from bayesdist.products.siaf import Aperture

__all__ = ["orientation_from_aperture"]


def orientation_from_aperture(
    solution: Solution,
    aperture: Aperture,
    *,
    chip: int = 2,
    epoch: float | None = None,
    scale_arcsec: float | None = None,
    scale_sigma: float = 0.0,
    sigma_position: float,
    sigma_angle_deg: float,
    instrument: str = "ACS",
    detector: str = "WFC",
) -> Orientation:
    """Lay a solution on an aperture of the Science Instrument Aperture File.

    The aperture's reference point goes to (V2Ref, V3Ref), and the detector's y axis there lies
    along the ideal Y axis, which is at V3IdlYAngle from V3 towards V2.

    Parameters
    ----------
    solution : Solution
        Without exposure frames.
    aperture : Aperture
    chip : int
        The chip on which the aperture's reference pixel lies.
    epoch : float, optional
        Decimal years; needed by a model with time dependence.
    scale_arcsec, scale_sigma : float
        As in `orientation_from_idctab`; needed for u, v in pixels.
    sigma_position, sigma_angle_deg : float
        Standard deviations of V2Ref and V3Ref [arcsec] and of V3IdlYAngle [deg].  The aperture file
        does not state them.
    instrument, detector : str
        For the parity of V2, V3 against Xc, Yc.

    Returns
    -------
    Orientation

    Raises
    ------
    InputError
        For a model with exposure frames, a missing epoch or scale, a parity other than the
        detector's, or u, v mirrored against x, y.
    """
    model = solution.model
    check_frames(solution)
    check_epoch(solution, epoch)
    parity = parity_of(instrument, detector)
    if aperture.v_idl_parity != parity[0] * parity[1]:
        raise InputError(
            f"VIdlParity is {aperture.v_idl_parity}, and that of {instrument}/{detector} is "
            f"{parity[0] * parity[1]}",
            where=f"aperture {aperture.name}",
            do="give an aperture of that detector",
        )
    held = held_scale(model.unit, scale_arcsec)
    if held is None:
        raise InputError(
            "an aperture gives no scale for u and v in pixels",
            where="scale_arcsec",
            do="give the arcseconds of one pixel of u, v",
        )
    x, y = (np.array([v], float) for v in aperture.reference_pixel)
    place = place_of(model, epoch=epoch, chip=chip)
    values = place.polynomial(solution.mean)
    [(columns, derivative)] = model.effective_jacobian(solution.mean, place.group)
    phi = place.basis.evaluate(x, y)[0]
    by_x, by_y = (g[0] for g in place.gradient(x, y))
    point, along_x, along_y = (complex(*(values @ g)) for g in (phi, by_x, by_y))
    if (np.conj(along_x) * along_y).imag <= 0:
        raise mirrored(f"aperture {aperture.name}")
    d_point, d_along = np.zeros((2, model.n_params), complex)
    for target, g in ((d_point, phi), (d_along, by_y)):
        du, dv = np.einsum("akm,k->am", derivative, g)
        target[columns] = du + 1j * dv
    a = np.deg2rad(aperture.v3_idl_y_angle)
    wanted = complex(parity[0] * np.sin(a), parity[1] * np.cos(a))
    angle = float(np.angle(wanted / along_y))
    b = held * np.exp(1j * angle)
    d_log = -1j * np.imag(d_along / along_y)
    shift = -b * point
    d_shift = -b * d_log * point - b * d_point
    return Orientation(
        angle=angle,
        scale=held,
        shift=np.array([shift.real, shift.imag]),
        v2v3=(aperture.v2_ref, aperture.v3_ref),
        reference_cov=cov_about(
            b * point,
            sigma_position**2,
            (scale_sigma / held) ** 2,
            np.deg2rad(sigma_angle_deg) ** 2,
        ),
        derivative=np.stack([d_shift.real, d_shift.imag, d_log.real, d_log.imag]),
        base=solution,
        source=f"chip {chip} laid on aperture {aperture.name} ({aperture.source})",
    )
