"""A polynomial to a tangent plane as one about another tangent point, for a header on the sky.

Two gnomonic planes of one sky differ by a projective map: with the axes E of each as the rows of a
matrix,

    (X, Y, W) = (xi, eta, 1) E_0 E_1^T,    (xi', eta') = (X, Y) / W

A polynomial of (x, y) through it is none, but nearly: the order is raised until what is left is
far below the errors of any centroid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.calibration.chip_map import ChipMap
from bayesdist.calibration.inverse import detector_grid
from bayesdist.data.tangent import ARCSEC, plane_axes, sky_of_plane, tangent_plane
from bayesdist.errors import InputError
from bayesdist.model import PolynomialBasis
from bayesdist.products.formats.sip.header import SIP_ORDERS
from bayesdist.products.monomials import ChipPolynomial

__all__ = ["SkyPolynomial", "sky_polynomial"]

Float = NDArray[np.float64]

LEFT = 1e-5  # of a pixel: a thousandth of the best centroids' errors
_NODES = 33


@dataclass(frozen=True, eq=False)
class SkyPolynomial:
    """The polynomial of a chip to the plane that touches the sky at CRVAL.

    Parameters
    ----------
    poly : ChipPolynomial
        About CRPIX, in the unit of the model; its constant is zero unless CRVAL lies where the
        model has no pixel.
    crval : tuple of float
        Degrees.
    offset : tuple of float
        CRVAL on the model's own plane, in its unit.
    """

    poly: ChipPolynomial
    crval: tuple[float, float]
    offset: tuple[float, float]

    @property
    def order(self) -> int:
        """Order of the polynomial."""
        return max(i + j for i, j in self.poly.terms)


def sky_polynomial(
    poly: ChipPolynomial,
    unit_arcsec: float,
    tangent_point: tuple[float, float],
    crval: tuple[float, float] | None = None,
) -> SkyPolynomial:
    """A chip's polynomial about the sky position of its reference pixel, or about a given one.

    Parameters
    ----------
    poly : ChipPolynomial
        To the plane of the tangent point.
    unit_arcsec : float
        Its unit, arcseconds.
    tangent_point : tuple of float
        Degrees.
    crval : tuple of float, optional
        Degrees.  CRPIX is then the pixel at which the solution has it.  Where the polynomial,
        continued, has no such pixel, CRPIX stays and the constants are what they must be.

    Returns
    -------
    SkyPolynomial

    Raises
    ------
    InputError
        For a CRVAL that is no position or 90 degrees or more from the field.
    """
    unit = unit_arcsec / ARCSEC
    own = PolynomialBasis(_order(poly), poly.chip.size, poly.chip.reference_pixel)
    coefficients = own.from_monomials(poly.values)
    crpix: tuple[float, float] | None = poly.chip.reference_pixel
    if crval is None:
        ra, dec = sky_of_plane(*(poly.constant * unit_arcsec), tangent_point)
        crval = float(ra), float(dec)
        offset = float(poly.constant[0]), float(poly.constant[1])
    else:
        crval, offset = _given(crval, unit_arcsec, tangent_point)
        crpix = _pixel_of(offset, own, coefficients, poly.linear)
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
    for order in range(max(own.order, SIP_ORDERS[0]), SIP_ORDERS[1] + 1):
        basis = PolynomialBasis(order, own.size, crpix or own.reference_pixel)
        design = basis.evaluate(x, y)
        inverse = np.linalg.pinv(design)
        legendre = inverse @ (projected / unit)
        left = np.abs(design @ legendre - projected / unit).max() / pixel
        if left <= LEFT:
            break
    values = basis.to_monomials(legendre.T)
    if crpix is not None and np.hypot(*values[:, 0]) > LEFT * pixel:
        # beyond the chip, where the fit holds less well: what is written is to have its zero there
        crpix = _pixel_of((0.0, 0.0), basis, legendre.T, values[:, 1:3])
        basis = replace(basis, reference_pixel=crpix or own.reference_pixel)
        values = basis.to_monomials(legendre.T)
    if crpix is not None:
        values[:, 0] = 0.0
    # each coefficient moves each new one: through the slope of the projection, then the fit
    moved = np.einsum("mn,nab,nl->amlb", inverse, slope, own.evaluate(x, y))
    from_powers = own.from_monomials(np.eye(own.n_terms))
    to_powers = np.einsum("km,amlb,jl->akjb", basis.monomial_matrix, moved, from_powers)
    jacobian = np.einsum("akjb,bjd->akd", to_powers, poly.jacobian)
    chip = replace(poly.chip, reference_pixel=basis.reference_pixel)
    return SkyPolynomial(ChipPolynomial(chip, basis.terms, values, jacobian), crval, offset)


def _order(poly: ChipPolynomial) -> int:
    return max(i + j for i, j in poly.terms)


def _given(
    crval: tuple[float, float], unit_arcsec: float, tangent_point: tuple[float, float]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """A position that the user gives, and where it lies on the model's plane."""
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


def _pixel_of(
    at: tuple[float, float], basis: PolynomialBasis, coefficients: Float, linear: Float
) -> tuple[float, float] | None:
    """The pixel of a position; None where the polynomial, continued so far, has none."""
    chip = ChipMap("solution", basis, "", coefficients)
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
