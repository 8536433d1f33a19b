"""Calibration of a SIP header."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import fitted_map
from bayesdist.calibration.plane import Plane
from bayesdist.model import polynomial_terms
from bayesdist.products.formats.common.document import MissingSizeError
from bayesdist.products.formats.sip.header import SIP_ORDERS, SipHeader

__all__ = ["sip_calibration"]

Float = NDArray[np.float64]


def sip_calibration(
    sip: SipHeader,
    name: str,
    *,
    size: tuple[float, float] | None = None,
    pixels: bool = False,
    notes: tuple[str, ...] = (),
) -> Calibration:
    """Calibration of a SIP header: one chip without number, with the header's sigmas if any.

    `size` is columns and rows, for a header without them (else MissingSizeError); with `pixels`,
    for a file without CD, (u, v) are corrected pixels, else arcseconds; `notes` go to the reader.
    """
    found = size if sip.size is None else (float(sip.size[0]), float(sip.size[1]))
    if found is None:
        raise MissingSizeError(
            "does not say how large the image is",
            where=name,
            do="add NAXIS1 and NAXIS2 (or IMAGEW and IMAGEH), or compare it with a file that says",
        )
    linear = np.eye(2) if pixels else sip.cd * (1.0 if sip.linear_axes else 3600.0)

    def positions(x: Float, y: Float) -> tuple[Float, Float]:
        if pixels:
            return sip.forward(x, y)
        xi, eta = sip.plane(x, y)
        if sip.linear_axes:
            return xi + sip.crval[0], eta + sip.crval[1]
        return 3600.0 * xi, 3600.0 * eta

    one = fitted_map(
        positions,
        name,
        order=max(sip.order) if min(sip.order) >= SIP_ORDERS[0] else 1,
        size=found,
        reference_pixel=sip.crpix,
        unit="pix" if pixels or sip.linear_axes else "arcsec",
        monomial_cov=_variances(sip, linear),
    )
    plane = Plane("detector") if pixels else Plane("sky", point=sip.crval)
    if sip.linear_axes:
        plane = Plane()
    return calibration_of_maps(
        {1: one},
        name,
        cov=one.cov,
        errors="sigma",
        plane=plane,
        numbered=False,
        notes=notes,
    )


def _variances(sip: SipHeader, linear: Float) -> Float | None:
    """Variances of a linear map of the header's sigmas; None where there are none."""
    if not sip.sigma_a and not sip.sigma_b:
        return None
    order = max(sip.order) if min(sip.order) >= SIP_ORDERS[0] else 1
    terms = polynomial_terms(order)
    sigma = [float(s.get(t, 0.0)) for s in (sip.sigma_a, sip.sigma_b) for t in terms]
    turn = np.kron(linear, np.eye(len(terms)))
    return (turn * np.array(sigma) ** 2) @ turn.T
