"""Build a SIP header from a solution: forward terms with their sigmas, and a checked inverse.

If CRVAL is not the tangent point of the solution, the polynomial is converted to the tangent plane
at CRVAL.  Two tangent planes are related by a projective map.  With the axes of each plane as the
rows of the matrices E_0 and E_1,

    (X, Y, W) = (xi, eta, 1) E_0 E_1^T,    (xi', eta') = (X, Y) / W

The result for a polynomial of (x, y) is not exactly a polynomial.  The order is increased until the
residuals are far below any centroid error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from bayesdist.calibration.calibration import Calibration, as_calibration
from bayesdist.calibration.chip_map import ChipMap, Monomials
from bayesdist.calibration.inverse import detector_grid, fit_inverse
from bayesdist.calibration.orientation import MAX_DEPARTURE, departure_from_tangent_plane
from bayesdist.calibration.plane import ARCSEC, arcsec_per
from bayesdist.data.tangent import ARCSEC as ARCSEC_PER_RADIAN
from bayesdist.data.tangent import plane_axes, sky_of_plane, tangent_plane
from bayesdist.errors import InputError
from bayesdist.formats.sip.files import sip_header
from bayesdist.formats.sip.header import (
    LINEAR_AXES,
    SIP_ORDERS,
    SipHeader,
    offset_ranges,
    worst_closure,
)
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import DistortionModel, PolynomialBasis
from bayesdist.model.basis import MAX_ORDER
from bayesdist.products.common.cards import (
    convergence_cards,
    number_card,
    text_card,
    wrapped_cards,
)
from bayesdist.products.common.coefficients import (
    largest_magnitude,
    propagated_sigma,
    require_regular,
)
from bayesdist.utils.arrays import Float

if TYPE_CHECKING:
    from astropy.wcs import WCS

# Largest deviation of the linear part from the identity if A and B hold the linear terms.
_NEAR_IDENTITY = 0.5
MAX_RESIDUAL = 1e-5  # pixels, tolerated residual: a thousandth of the errors of the best centroids
_NODES = 33  # points per axis of the grid on which the polynomial is fitted


def sip_from_solution(
    solution: Solution | Calibration,
    *,
    chip: int | None = None,
    epoch: float | None = None,
    inverse_order: int | None = None,
    linear: str = "cd",
    axes: str | None = None,
    crval: tuple[float, float] | None = None,
    tangent_point: tuple[float, float] | None = None,
    scale_arcsec: float | None = None,
    origin: tuple[float, float] | None = None,
    notes: Sequence[str] = (),
) -> SipHeader:
    """SIP header of one chip at one epoch.

    (u, v) are taken as the axes (xi, eta) of the tangent plane, in the frame of the first exposure.
    If the sky position of the tangent point is known, the header gives correct sky positions
    without further adjustment.

    Parameters
    ----------
    solution : LinearFit, Posterior or Calibration
        Solution of one or more chips.
    chip : int, optional
        Chip number; the first chip by default.
    epoch : float, optional
        Decimal year; required by a model with time dependence.
    inverse_order : int, optional
        Order of AP and BP, 2 to 9. The default is one above the order of A and B, at most 9.
    linear : {'cd', 'sip'}
        'cd': the linear part of the model is the CD matrix, A and B begin at order 2, and CRVAL is
        the position of the reference pixel. 'sip': the CD matrix is a pure scale, and A and B also
        hold constant and linear terms, relative to u = x and v = y in pixels, as in the WISE
        pipeline (WSDC D-T033, Appendix B); CRVAL is the position of `origin`.
    axes : {'sky', 'linear'}, optional
        'sky' writes celestial axes. 'linear', for u, v without a position on the sky, writes a
        CTYPE without projection, CD in the unit of u, v per pixel and CRVAL as the (u, v) of CRPIX,
        so that programs compute u, v instead of sky positions. The default is 'sky', except for
        angular u, v without sky position in a field so wide that other projections differ from a
        tangent plane.
    crval : tuple of float, optional
        Sky position that the header states, degrees. With `tangent_point`, the default is the
        position of the reference pixel; for another position, CRPIX is the pixel at that position.
        If the solution has no such pixel, A_0_0 and B_0_0 hold the offset. Without `tangent_point`,
        the value is written unchanged, (0, 0) by default.
    tangent_point : tuple of float, optional
        Sky position of (u, v) = (0, 0), degrees, such as `Matches.tangent_point`. The default is
        that of the calibration's plane, if it is on the sky. The polynomial is reprojected to the
        tangent plane of CRVAL with an accuracy of 1e-5 pixels, which may need a higher order.
    scale_arcsec : float, optional
        Arcseconds per pixel, for u, v in pixels; the default is a nominal 1 arcsec. With
        ``linear="sip"`` it also applies to angular u, v; the default is then their mean scale at
        the reference pixel.
    origin : tuple of float, optional
        (u, v) of the zero point for ``linear="sip"`` without `tangent_point`. The default is (0, 0)
        if u, v are offsets from the reference pixel, and the reference pixel if they are positions
        on the detector: whichever gives the smaller constant terms. The header states it in BDU0,
        BDV0.
    notes : sequence of str
        Sentences for COMMENT.

    Returns
    -------
    SipHeader
        Header with standard deviations, inverse and closure.

    Raises
    ------
    InputError
        If the chip or `linear` is unknown, the epoch is missing, an order cannot be written, the
        linear part is singular ('cd') or far from the identity ('sip'), the distortion has no
        inverse, a tangent point is given for u, v in pixels, or `crval` is not a position in the
        field.

    Examples
    --------
    >>> from bayesdist.formats import sip_from_solution
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, _ = simulate_wise(500, rng=np.random.default_rng(1))
    >>> fit = bd.fit_linear(matches, bd.build_model(matches, order=2, size=(1016, 1016)))
    >>> sip = sip_from_solution(fit, scale_arcsec=2.757)
    >>> sip.order
    (2, 2)
    """
    calibration = as_calibration(solution)
    if tangent_point is None:
        tangent_point = calibration.plane.point
    model = calibration.model
    _check_options(model, linear, epoch, scale_arcsec, tangent_point, origin)
    if axes is None:
        placed = model.unit == "pix" or tangent_point is not None or crval is not None
        wide = not placed and departure_from_tangent_plane(calibration, epoch, None) > MAX_DEPARTURE
        axes = "linear" if wide else "sky"
    in_frame = _is_in_frame(axes, tangent_point, crval)
    number = calibration.numbers[0] if chip is None else chip
    chip_map = calibration.chip(number, epoch, origin="stated")
    poly = chip_map.monomials()
    require_regular(poly.linear, number)
    unit_arcsec = arcsec_per(model.unit, scale_arcsec)
    sky = None
    if tangent_point is not None:
        sky = reprojected(chip_map, unit_arcsec, tangent_point, crval, *SIP_ORDERS)
        poly, crval = sky.poly, sky.crval
    order = max(SIP_ORDERS[0], *(i + j for i, j in poly.terms))  # readers ignore order 1
    inverse = _inverse_order(inverse_order, order)
    if linear == "cd":
        cd = poly.linear * unit_arcsec / 3600.0
        offset = (float(poly.constant[0]), float(poly.constant[1]))
        terms, sigma = _relative_to_linear(poly)
    else:
        pixel = _units_per_pixel(poly, model.unit, scale_arcsec)
        cd = np.eye(2) * pixel * unit_arcsec / 3600.0
        offset = _origin(poly, model.unit) if origin is None else origin
        terms, sigma = _relative_to_identity(poly, pixel, offset)
    if in_frame:
        cd, crval = cd * 3600.0 / unit_arcsec, offset
    written = [k for k, (i, j) in enumerate(poly.terms) if linear == "sip" or i + j >= 2]
    if sky is not None:
        offset = sky.offset
        if linear == "cd" and poly.constant.any():  # no pixel has CRVAL: only A and B can state it
            written.insert(0, poly.index(0, 0))
            notes = (*notes, "No pixel of the solution has CRVAL: A_0_0 and B_0_0 hold the rest.")
    a, b = ({poly.terms[k]: float(terms[axis, k]) for k in written} for axis in (0, 1))
    if not written:
        a = b = dict.fromkeys(((2, 0), (1, 1), (0, 2)), 0.0)
    cards = _cards(
        number,
        linear,
        epoch if model.time is not None else None,
        model.unit,
        scale_arcsec,
        in_frame=in_frame,
    )
    if not in_frame:
        cards += _sky_cards(tangent_point, crval)
    cards += (
        *wrapped_cards("COMMENT", filter(None, notes)),
        *convergence_cards(calibration.solution),
    )
    size = (int(poly.basis.size[0]), int(poly.basis.size[1]))
    sip = SipHeader(
        crpix=poly.basis.reference_pixel,
        crval=(0.0, 0.0) if crval is None else (float(crval[0]), float(crval[1])),
        cd=cd,
        ctype=LINEAR_AXES if in_frame else ("RA---TAN-SIP", "DEC--TAN-SIP"),
        order=(order, order),
        a=a,
        b=b,
        sigma_a={poly.terms[k]: float(sigma[0, k]) for k in written},
        sigma_b={poly.terms[k]: float(sigma[1, k]) for k in written},
        offset=offset,
        unit=model.unit,
        size=size,
        cards=cards,
    )
    ranges = offset_ranges(sip, size)
    ap, bp = fit_inverse(sip.forward, sip.crpix, size, inverse)
    sip = replace(
        sip,
        dmax=(largest_magnitude(a, *ranges), largest_magnitude(b, *ranges)),
        inverse_order=(inverse, inverse),
        ap=ap,
        bp=bp,
    )
    return replace(sip, closure=worst_closure(sip, size))


def sip_wcs(calibration: Calibration, crval: tuple[float, float]) -> WCS:
    """`astropy.wcs.WCS` with the SIP header of a one-chip calibration on the sky.

    `crval` is the sky position of the tangent point in degrees, so that the polynomial is
    unchanged.
    """
    from astropy.wcs import WCS  # slow to import

    wcs = WCS(sip_header(sip_from_solution(calibration, crval=crval)))
    [chip] = calibration.model.chips
    wcs.pixel_shape = round(chip.size[0]), round(chip.size[1])
    return wcs


def _check_options(
    model: DistortionModel,
    linear: str,
    epoch: float | None,
    scale_arcsec: float | None,
    tangent_point: tuple[float, float] | None,
    origin: tuple[float, float] | None,
) -> None:
    """Raise InputError for options that contradict each other or the model."""
    if linear not in ("cd", "sip"):
        raise InputError(
            f"linear is {linear!r}", where="products.sip.linear", do="choose 'cd' or 'sip'"
        )
    if scale_arcsec is not None and not (np.isfinite(scale_arcsec) and scale_arcsec > 0):
        raise InputError(f"scale is {scale_arcsec} arcsec per pixel", do="give a positive number")
    if model.time is not None and epoch is None:
        raise InputError(
            "a SIP header holds for one epoch, but the model depends on time",
            where="epoch",
            do="give an epoch in decimal years (assess.epoch in a configuration)",
        )
    if tangent_point is not None and (model.unit == "pix" or origin is not None):
        raise InputError(
            "a tangent point is given together with u, v in pixels or a chosen origin",
            where="tangent_point",
            do="leave one of them out",
        )


def _is_in_frame(
    axes: str,
    tangent_point: tuple[float, float] | None,
    crval: tuple[float, float] | None,
) -> bool:
    """True for linear axes, after checking that u, v have no position on the sky."""
    if axes not in ("sky", "linear"):
        raise InputError(
            f"axes is {axes!r}", where="products.sip.axes", do="choose 'sky' or 'linear'"
        )
    if axes == "sky":
        return False
    if tangent_point is not None or crval is not None:
        raise InputError(
            "linear axes are for u, v without a position on the sky, but these have one",
            where="products.sip.axes",
            do="leave out axes or crval",
        )
    return True


def _inverse_order(asked: int | None, order: int) -> int:
    if asked is None:
        return min(order + 1, SIP_ORDERS[1])
    if not SIP_ORDERS[0] <= asked <= SIP_ORDERS[1]:
        raise InputError(
            f"inverse order is {asked}",
            where="products.sip.inverse_order",
            do=f"choose an order from {SIP_ORDERS[0]} to {SIP_ORDERS[1]}",
        )
    return asked


def _units_per_pixel(poly: Monomials, unit: str, scale_arcsec: float | None) -> float:
    """Units of u, v per pixel, after checking that (u, v) are aligned with (x, y)."""
    if unit == "pix":
        pixel = 1.0
    elif scale_arcsec is not None:
        pixel = scale_arcsec / ARCSEC[unit]
    else:
        pixel = float(np.sqrt(abs(np.linalg.det(poly.linear))))
    if np.abs(poly.linear / pixel - np.eye(2)).max() > _NEAR_IDENTITY:
        raise InputError(
            "u and v do not run along x and y, so the linear part is not a small correction of "
            "pixels",
            where="products.sip.linear",
            do="choose 'cd'",
        )
    return pixel


def _relative_to_linear(poly: Monomials) -> tuple[Float, Float]:
    """A, B = L^-1 C of every term, and their sigmas from dA = L^-1 (dC - dL A)."""
    terms = np.linalg.solve(poly.linear, poly.values)
    K = len(poly.terms)
    inner = np.eye(K)
    inner[:, 1:3] -= terms.T  # dL is the change of the two linear terms
    return np.asarray(terms), _sigma(np.kron(np.linalg.inv(poly.linear), inner), poly)


def _sigma(by: Float, poly: Monomials) -> Float:
    """Standard deviations (2, K) after a linear map `by` of the coefficients."""
    if poly.cov is None:
        return np.zeros(poly.values.shape)
    return propagated_sigma(by, poly.cov).reshape(2, -1)


def _origin(poly: Monomials, unit: str) -> tuple[float, float]:
    """(0, 0), or the reference pixel if that is nearer to the constant term of the model."""
    reference = poly.basis.reference_pixel
    from_reference = np.hypot(*(poly.constant - reference))
    positions = unit == "pix" and from_reference < np.hypot(*poly.constant)
    return reference if positions else (0.0, 0.0)


def _relative_to_identity(
    poly: Monomials, pixel: float, origin: tuple[float, float]
) -> tuple[Float, Float]:
    """Model in pixels relative to the origin minus u = x and v = y, and its sigmas."""
    terms = poly.values / pixel
    for axis, power in enumerate(((1, 0), (0, 1))):
        terms[axis, poly.index(0, 0)] -= origin[axis] / pixel
        terms[axis, poly.index(*power)] -= 1.0
    return terms, _sigma(np.eye(2 * len(poly.terms)) / pixel, poly)


def _cards(
    chip: int,
    linear: str,
    epoch: float | None,
    unit: str,
    scale_arcsec: float | None,
    *,
    in_frame: bool,
) -> tuple[str, ...]:
    """Cards of values that are not fields of a SipHeader; `in_frame` is True for linear axes."""
    axes_unit = {"pix": "pixel"}.get(unit, unit) if in_frame else "deg"
    convention = {
        "cd": "CD holds the linear terms; A and B begin at order 2.",
        "sip": "CD is a pure scale; A and B hold constant and linear terms.",
    }[linear]
    cards = [
        text_card("COMMENT", f"Distortion of chip {chip}, by bayesdist."),
        text_card("COMMENT", convention),
        text_card("COMMENT", "A_p_q multiplies u^p v^q; AE_p_q and BE_p_q are 1-sigma errors."),
    ]
    if unit == "pix" and scale_arcsec is None and not in_frame:
        cards.append(text_card("COMMENT", "The scale of CD is nominal: 1 arcsec per pixel."))
    cards += [
        number_card("WCSAXES", 2, "number of axes"),
        text_card("CUNIT1", axes_unit),
        text_card("CUNIT2", axes_unit),
        number_card("BDCHIP", chip, "chip number"),
    ]
    if epoch is not None:
        cards.append(number_card("BDEPOCH", float(epoch), "[yr] epoch of the coefficients"))
    return tuple(cards)


def _sky_cards(
    tangent_point: tuple[float, float] | None, crval: tuple[float, float] | None
) -> tuple[str, ...]:
    """Cards on the origin of CRVAL."""
    if tangent_point is None:
        if crval is not None:
            return ()
        return (
            text_card("COMMENT", "Where u, v lie on the sky is not known: CRVAL is a placeholder."),
        )
    return (
        text_card("COMMENT", "CRVAL and CRPIX are those of the solution, on the sky of its stars."),
        number_card("LONPOLE", 180.0, "[deg] north is up also at a pole"),
        number_card("BDTAN1", float(tangent_point[0]), "[deg] sky position of u, v = 0: RA"),
        number_card("BDTAN2", float(tangent_point[1]), "[deg] sky position of u, v = 0: Dec"),
    )


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
    unit = unit_arcsec / ARCSEC_PER_RADIAN
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
        if residual <= MAX_RESIDUAL:
            break
    values = basis.to_monomials(legendre.T)
    if crpix is not None and np.hypot(*values[:, 0]) > MAX_RESIDUAL * pixel:
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
