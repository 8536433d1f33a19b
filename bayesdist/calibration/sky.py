"""Conversion of a polynomial from one tangent plane to another tangent point.

Two tangent planes are related by a projective map.  With the axes of each plane as the rows of the
matrices E_0 and E_1,

    (X, Y, W) = (xi, eta, 1) E_0 E_1^T,    (xi', eta') = (X, Y) / W

The result for a polynomial of (x, y) is not exactly a polynomial.  The order is increased until the
residuals are far below any centroid error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.calibration.chip_map import ChipMap, Monomials
from bayesdist.calibration.inverse import detector_grid
from bayesdist.data.sky import ARCSEC, plane_axes, sky_of_plane, tangent_plane
from bayesdist.errors import InputError
from bayesdist.model import PolynomialBasis
from bayesdist.model.basis import MAX_ORDER
from bayesdist.utils.arrays import Float

LEFT = 1e-5  # pixels, tolerated residual: a thousandth of the errors of the best centroids
_NODES = 33  # points per axis of the grid for the fit


@dataclass(frozen=True, eq=False)
class Reprojected:
    """Polynomial of a chip to the tangent plane at CRVAL."""

    poly: Monomials  # about CRPIX, in the unit of the map; constants are 0 if a pixel has CRVAL
    crval: tuple[float, float]  # degrees
    offset: tuple[float, float]  # CRVAL on the original plane, in its unit


def reprojected(
    chip: ChipMap,
    unit_arcsec: float,
    tangent_point: tuple[float, float],
    crval: tuple[float, float] | None = None,
    lowest: int = 1,
    highest: int = MAX_ORDER,
) -> Reprojected:
    """Polynomial of a chip about the sky position of its reference pixel, or about a given CRVAL.

    Parameters
    ----------
    chip : ChipMap
        Map to the original tangent plane.
    unit_arcsec : float
        Arcseconds per unit of the map.
    tangent_point : tuple of float
        Tangent point of the original plane in degrees.
    crval : tuple of float, optional
        New tangent point in degrees.  CRPIX is the pixel that maps to it.  If there is no such
        pixel, even outside of the chip, CRPIX is the reference pixel of the map and the constant
        terms are not zero.
    lowest, highest : int
        Range of the order of the result.

    Returns
    -------
    Reprojected

    Raises
    ------
    InputError
        If CRVAL is invalid or 90 degrees or more from the field.
    """
    unit = unit_arcsec / ARCSEC
    original_basis, coefficients, poly = chip.basis, chip.coefficients, chip.monomials()
    crpix: tuple[float, float] | None = original_basis.reference_pixel
    if crval is None:
        xi, eta = unit_arcsec * poly.constant
        ra, dec = sky_of_plane(xi, eta, tangent_point)
        crval = float(ra), float(dec)
        offset = float(poly.constant[0]), float(poly.constant[1])
    else:
        crval, offset = _given(crval, unit_arcsec, tangent_point)
        crpix = _pixel_of(offset, chip, poly.linear)
    between = plane_axes(crval) @ plane_axes(tangent_point).T
    x, y = detector_grid(original_basis.size, _NODES, chebyshev=True)
    plane = original_basis.evaluate(x, y) @ coefficients.T * unit
    projected, slope = _projected(plane, between)
    if projected is None:
        raise InputError(
            f"crval is {crval}, but the field is 90 degrees or more from there",
            where="products.sip.crval",
            do="give a position in the field, or omit crval",
        )
    pixel = float(np.sqrt(abs(np.linalg.det(poly.linear))))
    for order in range(max(original_basis.order, lowest), highest + 1):
        basis = PolynomialBasis(order, original_basis.size, crpix or original_basis.reference_pixel)
        design = basis.evaluate(x, y)
        inverse = np.linalg.pinv(design)
        legendre = inverse @ (projected / unit)
        residual = np.abs(design @ legendre - projected / unit).max() / pixel
        if residual <= LEFT:
            break
    values = basis.to_monomials(legendre.T)
    if crpix is not None and np.hypot(*values[:, 0]) > LEFT * pixel:
        # CRPIX is outside of the chip, where the fit is less accurate: solve for the zero again
        reprojected_map = ChipMap(chip.name, basis, chip.unit, legendre.T)
        crpix = _pixel_of((0.0, 0.0), reprojected_map, values[:, 1:3])
        basis = replace(basis, reference_pixel=crpix or original_basis.reference_pixel)
        values = basis.to_monomials(legendre.T)
    if crpix is not None:
        values[:, 0] = 0.0
    cov = None
    if chip.cov is not None:
        # derivatives of the new coefficients: slope of the projection, then the fit
        moved = np.einsum("mn,nab,nl->amlb", inverse, slope, original_basis.evaluate(x, y))
        jacobian = np.einsum("km,amlb->akbl", basis.monomial_matrix, moved)
        jacobian = jacobian.reshape(2 * basis.n_terms, -1)
        cov = jacobian @ chip.cov @ jacobian.T
    return Reprojected(Monomials(basis, values, cov), crval, offset)


def _given(
    crval: tuple[float, float], unit_arcsec: float, tangent_point: tuple[float, float]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Validated CRVAL, and its position on the original plane in the unit of the map."""
    if not (np.isfinite(crval).all() and -90 <= crval[1] <= 90):
        raise InputError(
            f"crval is {crval}, which is not a right ascension and declination in degrees",
            where="products.sip.crval",
            do="correct it, or omit it",
        )
    try:
        xi, eta = tangent_plane([crval[0]], [crval[1]], tangent_point)
    except InputError:
        raise InputError(
            f"crval is {crval}, which is 90 degrees or more from the stars at {tangent_point}",
            where="products.sip.crval",
            do="give a position in the field, or omit crval",
        ) from None
    at = float(xi[0]) / unit_arcsec, float(eta[0]) / unit_arcsec
    return (float(crval[0]), float(crval[1])), at


def _pixel_of(at: tuple[float, float], chip: ChipMap, linear: Float) -> tuple[float, float] | None:
    """Pixel of a position on the plane; None if there is none, also outside of the chip."""
    pixel, slope = chip.pixels(np.array(at)[:, None])
    if not np.isfinite(pixel).all() or np.linalg.det(slope[0]) * np.linalg.det(linear) <= 0:
        return None  # beyond a fold of the polynomial
    return float(pixel[0, 0]), float(pixel[1, 0])


def _projected(plane: Float, between: Float) -> tuple[Float | None, Float]:
    """Positions (N, 2) on the new plane in radians, and their derivatives (N, 2, 2).

    `plane` (N, 2) are positions on the original plane in radians, `between` is E_0 E_1^T
    transposed.  The positions are None if a point is 90 degrees or more from the new tangent point.
    """
    X = plane @ between[:, :2].T + between[:, 2]
    if X[:, 2].min() <= 0:
        return None, np.zeros((len(plane), 2, 2))
    at = X[:, :2] / X[:, 2:]
    slope = (between[:2, :2] - at[:, :, None] * between[2, :2]) / X[:, 2, None, None]
    return at, slope
