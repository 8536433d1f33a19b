"""A polynomial to a tangent plane, converted to one about another tangent point.

Two gnomonic planes of one sky differ by a projective map: with the axes E of each as the rows of a
matrix,

    (X, Y, W) = (xi, eta, 1) E_0 E_1^T,    (xi', eta') = (X, Y) / W

The result for a polynomial of (x, y) is no polynomial, but nearly: the order is raised until the
rest is far below the errors of any centroid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.calibration.chip_map import ChipMap, Monomials
from bayesdist.calibration.inverse import detector_grid
from bayesdist.data.sky.tangent import ARCSEC, plane_axes, sky_of_plane, tangent_plane
from bayesdist.errors import InputError
from bayesdist.model import PolynomialBasis
from bayesdist.model.basis import MAX_ORDER
from bayesdist.utils.arrays import Float

LEFT = 1e-5  # of a pixel: a thousandth of the best centroids' errors
_NODES = 33


@dataclass(frozen=True, eq=False)
class Reprojected:
    """Polynomial of a chip to the plane that touches the sky at CRVAL."""

    poly: Monomials  # about CRPIX, in the map's unit; constant 0 if a pixel has CRVAL
    crval: tuple[float, float]  # degrees
    offset: tuple[float, float]  # CRVAL on the model's own plane, in its unit


def reprojected(
    chip: ChipMap,
    unit_arcsec: float,
    tangent_point: tuple[float, float],
    crval: tuple[float, float] | None = None,
    lowest: int = 1,
    highest: int = MAX_ORDER,
) -> Reprojected:
    """Polynomial of a chip about the sky position of its reference pixel, or about a given CRVAL.

    `tangent_point` (degrees) is of the plane of `chip`, whose unit has `unit_arcsec`; the result is
    of an order from `lowest` to `highest`.  With `crval` (degrees) the reference pixel is that at
    which the map has it; where the polynomial, continued, has no such pixel, it stays and the
    constants follow.
    InputError for a CRVAL that is no position or 90 degrees or more from the field.
    """
    unit = unit_arcsec / ARCSEC
    own, coefficients, poly = chip.basis, chip.coefficients, chip.monomials()
    crpix: tuple[float, float] | None = own.reference_pixel
    if crval is None:
        xi, eta = unit_arcsec * poly.constant
        ra, dec = sky_of_plane(xi, eta, tangent_point)
        crval = float(ra), float(dec)
        offset = float(poly.constant[0]), float(poly.constant[1])
    else:
        crval, offset = _given(crval, unit_arcsec, tangent_point)
        crpix = _pixel_of(offset, chip, poly.linear)
    between = plane_axes(crval) @ plane_axes(tangent_point).T
    x, y = detector_grid(own.size, _NODES, chebyshev=True)
    plane = own.evaluate(x, y) @ coefficients.T * unit
    projected, slope = _projected(plane, between)
    if projected is None:
        raise InputError(
            f"crval is {crval}, and the field lies 90 degrees or more from there",
            where="products.sip.crval",
            do="give a position in the field, or leave crval out",
        )
    pixel = float(np.sqrt(abs(np.linalg.det(poly.linear))))
    for order in range(max(own.order, lowest), highest + 1):
        basis = PolynomialBasis(order, own.size, crpix or own.reference_pixel)
        design = basis.evaluate(x, y)
        inverse = np.linalg.pinv(design)
        legendre = inverse @ (projected / unit)
        left = np.abs(design @ legendre - projected / unit).max() / pixel
        if left <= LEFT:
            break
    values = basis.to_monomials(legendre.T)
    if crpix is not None and np.hypot(*values[:, 0]) > LEFT * pixel:
        # beyond the chip, where the fit is less good: the result must have its zero there
        about = ChipMap(chip.name, basis, chip.unit, legendre.T)
        crpix = _pixel_of((0.0, 0.0), about, values[:, 1:3])
        basis = replace(basis, reference_pixel=crpix or own.reference_pixel)
        values = basis.to_monomials(legendre.T)
    if crpix is not None:
        values[:, 0] = 0.0
    cov = None
    if chip.cov is not None:
        # each coefficient moves each new one: through the slope of the projection, then the fit
        moved = np.einsum("mn,nab,nl->amlb", inverse, slope, own.evaluate(x, y))
        by = np.einsum("km,amlb->akbl", basis.monomial_matrix, moved)
        by = by.reshape(2 * basis.n_terms, -1)
        cov = by @ chip.cov @ by.T
    return Reprojected(Monomials(basis, values, cov), crval, offset)


def _given(
    crval: tuple[float, float], unit_arcsec: float, tangent_point: tuple[float, float]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Position that the user gives, and its image on the model's plane."""
    if not (np.isfinite(crval).all() and -90 <= crval[1] <= 90):
        raise InputError(
            f"crval is {crval}, no right ascension and declination in degrees",
            where="products.sip.crval",
            do="correct it, or leave it out",
        )
    try:
        xi, eta = tangent_plane([crval[0]], [crval[1]], tangent_point)
    except InputError:
        raise InputError(
            f"crval is {crval}, which lies 90 degrees or more from the stars at {tangent_point}",
            where="products.sip.crval",
            do="give a position in the field, or leave crval out",
        ) from None
    at = float(xi[0]) / unit_arcsec, float(eta[0]) / unit_arcsec
    return (float(crval[0]), float(crval[1])), at


def _pixel_of(at: tuple[float, float], chip: ChipMap, linear: Float) -> tuple[float, float] | None:
    """Pixel of a position; None where the polynomial, continued so far, has none."""
    pixel, slope = chip.pixels(np.array(at)[:, None])
    if not np.isfinite(pixel).all() or np.linalg.det(slope[0]) * np.linalg.det(linear) <= 0:
        return None  # beyond a fold of the polynomial, which no chip has
    return float(pixel[0, 0]), float(pixel[1, 0])


def _projected(plane: Float, between: Float) -> tuple[Float | None, Float]:
    """Positions (N, 2) on the other plane and their derivatives (N, 2, 2), radians."""
    X = plane @ between[:, :2].T + between[:, 2]
    if X[:, 2].min() <= 0:
        return None, np.zeros((len(plane), 2, 2))
    at = X[:, :2] / X[:, 2:]
    slope = (between[:2, :2] - at[:, :, None] * between[2, :2]) / X[:, 2, None, None]
    return at, slope
