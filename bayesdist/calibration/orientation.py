"""Orientation of a calibration relative to another one or on the sky, with its error.

Shift, rotation, scale and parity between two maps A and B are determined by least squares over the
area of a chip.  With the Legendre coefficients of w = u + i v,

    w_A = shift + turn w_B + d        (or the conjugate of w_B if one of them is mirrored)

Means of products of two polynomials over the chip follow directly from the coefficients, so that no
grid is needed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import scaled
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.plane import ARCSEC, Agreement, Orientation, Plane, arcsec_per
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.solution.solution import DerivedSolution, Solution
from bayesdist.model import DistortionModel, PolynomialBasis
from bayesdist.model.alignment import turned, turned_model
from bayesdist.model.grid import DEFAULT_GRID, grid_pixels, mesh
from bayesdist.utils.arrays import Complex, Float
from bayesdist.utils.quantities import Random, generator_of

# Largest accepted difference in pixels between TAN and other projections, in a header of a
# calibration whose u, v have no position on the sky.
MAX_DEPARTURE = 0.1


def lay_on(
    calibration: Calibration,
    reference: Calibration,
    *,
    chip: int = 2,
    epoch: float | None = None,
    reference_drift: bool = True,
    scale_arcsec: float | None = None,
) -> Orientation:
    """Similarity from a calibration to a reference in an aperture [arcsec], with its error.

    Shift, rotation and, for u and v in pixels, scale minimise the mean square distance between the
    two maps of one chip over its area; the same similarity applies to all chips.  The fit uses the
    whole chip rather than the linear terms at the reference pixel.  All pixels have equal weight,
    so that a term that only one calibration has, or a poorly measured fifth order, cannot rotate
    the result.  Both methods agree if the two maps differ only by a similarity.

    The residuals of the fit have 2 K - 4 free coefficients (K terms per axis).  The four parameters
    of the similarity are given the mean variance of these coefficients: the reference may be as
    wrong in roll and scale as it is, on average, in any other term.  If the residuals were treated
    as white noise on the pixels, the stated errors would be far too small.

    Parameters
    ----------
    calibration : Calibration
        Calibration to be oriented.
    reference : Calibration
        Existing calibration in the aperture.
    chip : int
        Number of the chip over which the maps are compared.
    epoch : float, optional
        Decimal years; required if the calibration depends on time.
    reference_drift : bool
        True to apply the time-dependent terms of the reference.
    scale_arcsec : float, optional
        Fixed scale, in arcsec per unit of u and v.  By default the scale is fitted for u and v in
        pixels, and is the size of the unit otherwise.

    Returns
    -------
    Orientation

    Raises
    ------
    InputError
        If the chip is missing or differs in size, the epoch is missing, the drift of the reference
        cannot be evaluated, the scale is not positive, or u and v are mirrored against x and y.
    DegenerateError
        If the calibration maps the chip to one point.
    """
    model = calibration.model
    if model.time is not None and epoch is None:
        raise InputError(
            "the solution depends on time, but no epoch is given",
            where="epoch",
            do="give the decimal year at which it is compared with the reference",
        )
    size = model.chips[model.chip_code(chip)].size
    reference_size = reference.model.chips[reference.model.chip_code(chip)].size
    if tuple(size) != tuple(reference_size):
        raise InputError(
            f"chip {chip} has {reference_size[0]:g} x {reference_size[1]:g} pixels, but in the "
            f"solution {size[0]:g} x {size[1]:g}",
            where=reference.name,
            do="give a reference of the same detector",
        )
    dated = reference.model.time is not None or reference.no_date
    then = epoch if reference_drift and dated else None
    order = max(model.order, reference.model.order)
    basis = PolynomialBasis(order, size, model.chips[0].reference_pixel)
    z, slopes = _complex(*calibration.coefficients(chip, epoch), basis.n_terms)
    w, _ = _complex(*reference.coefficients(chip, then), basis.n_terms)
    weight = basis.mean_squares
    weight[0] = 0.0  # the mean is absorbed by the shift
    S, flipped, Q = correlations(w, z, basis)
    if Q == 0 or S == 0:
        raise DegenerateError(
            "the solution maps the chip to one point",
            where=reference.name,
            do="check its linear terms",
        )
    if abs(flipped) > abs(S):
        raise InputError(
            "u and v are mirrored against the detector's x and y",
            where=reference.name,
            do="let u increase with x and v with y, or change the sign of one of them",
        )
    dS = (weight * w) @ slopes.conj()
    held = _held_scale(model.unit, scale_arcsec)
    if held is None:
        b = S / Q
        d_log = (dS / Q - b * 2 * np.real((weight * z.conj()) @ slopes) / Q) / b
    else:
        b = complex(held * S / abs(S))
        d_log = np.asarray(1j * np.imag(dS / S), complex)
    shift = complex(w[0] - b * z[0])
    d_shift = -b * d_log * z[0] - b * slopes[0]

    residual = np.asarray(w - b * z, complex)
    residual[0] -= shift
    agreement = _agreement(residual, basis)
    n_free = 2 * basis.n_terms - (4 if held is None else 3)
    variance = (1e-3 * agreement.rms) ** 2 / n_free
    angular = variance / (abs(b) ** 2 * Q)
    log_scale = angular if held is None else 0.0
    return Orientation(
        angle=float(np.angle(b)),
        scale=float(abs(b)) if held is None else held,
        shift=np.array([shift.real, shift.imag]),
        v2v3=reference.plane.v2v3 or (0.0, 0.0),
        reference_cov=_cov_about(b * z[0], variance, log_scale, angular),
        derivative=np.stack([d_shift.real, d_shift.imag, d_log.real, d_log.imag]),
        base=calibration.solution,
        source=f"chip {chip} laid on {reference.name.rpartition('/')[2]}"
        + ("" if epoch is None else f" at {epoch:g}"),
        agreement=agreement,
    )


def oriented(calibration: Calibration, orientation: Orientation) -> Calibration:
    """Apply an orientation: calibration in the plane of an aperture, in arcseconds.

    The errors of the orientation are included.  All terms of both axes are rotated, including those
    that depend on time: if (u, i, j) drifts, (v, i, j) does after the rotation, so that the model
    of the result has both.  The calibration is either the one for which the orientation was
    determined, or that of another filter in the same system, which is assumed to be independent.
    Raises InputError if its unit differs from that of the orientation.
    """
    solution, base, model = calibration.solution, orientation.base, calibration.model
    if model.unit != base.model.unit:
        raise InputError(
            f"the solution is in {model.unit}, but the orientation is for {base.model.unit}",
            where="model.unit",
            do="orient only solutions in the same system",
        )
    mean, cov = np.asarray(solution.mean, float), np.asarray(solution.cov, float)
    turn = orientation.scale * np.exp(1j * orientation.angle)
    linear = turned(model, np.eye(model.n_params), turn, 0.0).T
    moved = turned(model, mean, turn, complex(*orientation.shift))
    # derivatives with respect to shift_x, shift_y, log_scale, angle
    by = np.stack(
        [
            turned(model, 0 * mean, turn, 1.0),
            turned(model, 0 * mean, turn, 1j),
            turned(model, mean, turn, 0.0),
            turned(model, mean, 1j * turn, 0.0),
        ],
        axis=1,
    )
    if solution is base:
        total = linear + by @ orientation.derivative
        with_plane = total @ cov @ orientation.derivative.T + by @ orientation.reference_cov
        oriented_cov = total @ cov @ total.T + by @ orientation.reference_cov @ by.T
    else:
        with_plane = by @ orientation.cov
        oriented_cov = linear @ cov @ linear.T + with_plane @ by.T
    new = replace(turned_model(model), unit="arcsec")
    return replace(
        calibration,
        solution=_Oriented(new, moved, (oriented_cov + oriented_cov.T) / 2, solution, orientation),
        plane=Plane("aperture", v2v3=orientation.v2v3, orientation=orientation),
        with_plane=with_plane,
        scale=None,
    )


@dataclass(frozen=True, eq=False)
class _Oriented(DerivedSolution):
    """Solution in the plane of an aperture; each draw is rotated by a draw of the orientation."""

    model: DistortionModel
    mean: Float
    cov: Float
    source: Solution
    orientation: Orientation

    def draws(self, n: int, rng: Random) -> Float:
        """Parameter vectors, shape (n, D)."""
        generator = generator_of(rng)
        o = self.orientation
        theta = np.asarray(self.source.draws(n, generator), float)
        if self.source is o.base:
            moved = (theta - np.asarray(o.base.mean)) @ o.derivative.T
            spread = o.reference_cov
        else:
            moved, spread = np.zeros((n, 4)), o.cov
        moved = moved + generator.multivariate_normal(np.zeros(4), spread, size=n, method="eigh")
        turn = o.scale * np.exp(moved[:, 2] + 1j * (o.angle + moved[:, 3]))
        shift = complex(*o.shift) + moved[:, 0] + 1j * moved[:, 1]
        return turned(self.source.model, theta, turn, shift)


def _complex(coefficients: Float, jacobian: Float, n_terms: int) -> tuple[Complex, Complex]:
    """Coefficients (n,) of u + i v and their derivatives (n, D), zero for missing terms."""
    K = coefficients.shape[1]
    z = np.zeros(n_terms, complex)
    z[:K] = coefficients[0] + 1j * coefficients[1]
    slopes = np.zeros((n_terms, jacobian.shape[1]), complex)
    slopes[:K] = jacobian[:K] + 1j * jacobian[K:]
    return z, slopes


def _agreement(left: Complex, basis: PolynomialBasis) -> Agreement:
    """Rms and largest distance on a chip, from Legendre coefficients of a residual [arcsec]."""
    on_grid = basis.evaluate(*mesh(*grid_pixels(basis.size, DEFAULT_GRID))) @ left
    return Agreement(
        rms=1e3 * float(np.sqrt(basis.mean_squares @ np.abs(left) ** 2)),
        worst=1e3 * float(np.abs(on_grid).max()),
    )


def _held_scale(unit: str, scale_arcsec: float | None) -> float | None:
    """Arcseconds per unit of u and v, or None if the scale is to be fitted."""
    if scale_arcsec is None:
        return None if unit == "pix" else ARCSEC[unit]
    if not (np.isfinite(scale_arcsec) and scale_arcsec > 0):
        raise InputError(
            f"the scale is {scale_arcsec}", where="scale_arcsec", do="give a positive number"
        )
    return float(scale_arcsec)


def _cov_about(arm: complex, variance: float, log_scale: float, angular: float) -> Float:
    """Covariance (4, 4) of shift_x, shift_y, log_scale and angle.

    The shift refers to (u, v) = (0, 0).  This is offset by -`arm` from the point about which the
    errors of position, scale and angle are independent.
    """
    to_origin = np.eye(4)
    to_origin[:2, 2] = -arm.real, -arm.imag
    to_origin[:2, 3] = arm.imag, -arm.real
    return to_origin @ np.diag([variance, variance, log_scale, angular]) @ to_origin.T


def placed_at(
    calibration: Calibration,
    crval: tuple[float, float] | None,
    scale_arcsec: float | None,
    *,
    where: str,
) -> Calibration:
    """Place a calibration on the sky, with u increasing to the east and v to the north.

    Parameters
    ----------
    calibration : Calibration
    crval : tuple of float or None
        Right ascension and declination of (u, v) = (0, 0) in degrees.  If it is None, the
        calibration is returned unchanged.
    scale_arcsec : float or None
        Pixel scale in arcsec per pixel, to convert u and v from pixels.
    where : str
        Section of the configuration, for error messages.

    Returns
    -------
    Calibration

    Raises
    ------
    InputError
        If the plane has a position on the sky already, CRVAL is invalid, or the pixel scale is
        unknown.
    """
    if crval is None:
        return calibration
    if calibration.plane.point is not None:
        raise InputError(
            "a crval is given for a plane that has a position on the sky already",
            where=f"{where}.crval",
            do="omit it",
        )
    if not (np.isfinite(crval).all() and -90 <= crval[1] <= 90):
        raise InputError(
            f"crval is {crval}, which is not a right ascension and declination in degrees",
            where=f"{where}.crval",
            do="correct it, or omit it",
        )
    if calibration.unit == "pix":
        if scale_arcsec is None:
            raise InputError(
                "a crval is given, but u and v are in pixels of unknown size",
                where="detector.scale_mas",
                do="give the pixel scale (scale_mas in Python, --scale of convert)",
            )
        calibration = in_arcsec(calibration, scale_arcsec)
    plane = Plane("sky", point=(float(crval[0]), float(crval[1])), note=calibration.plane.note)
    return replace(calibration, plane=plane, with_plane=None)


def departure_from_tangent_plane(
    calibration: Calibration, epoch: float | None, scale_arcsec: float | None
) -> float:
    """Largest difference in pixels between TAN and another projection over the detector.

    In a small field all projections about the same point agree.  At a distance r, in radians, the
    difference between a tangent plane and an equidistant projection (ARC) is r - atan r.
    `scale_arcsec` is the size of a pixel, for u and v in pixels.
    """
    unit, worst = arcsec_per(calibration.unit, scale_arcsec), 0.0
    for chip_map in calibration.at(epoch, origin="stated").values():
        poly = chip_map.monomials()
        x, y = detector_grid(chip_map.basis.size, 3)
        offsets = np.stack([x, y]) - np.array(chip_map.basis.reference_pixel)[:, None]
        radians = np.radians(unit * np.hypot(*(poly.linear @ offsets)) / 3600.0)
        pixel = np.sqrt(abs(np.linalg.det(poly.linear))) * unit
        departure = np.degrees(radians - np.arctan(radians)).max() * 3600.0 / pixel
        worst = max(worst, float(departure))
    return worst


def refuse_wide_planes(
    calibration: Calibration, epoch: float | None, scale_arcsec: float | None, *, where: str
) -> None:
    """Raise InputError for a wide field if the plane (u, v) has no position on the sky.

    In a wide field the choice of a tangent plane (TAN) matters.  `epoch` and `scale_arcsec` are
    those of `departure_from_tangent_plane`; `where` is the section of the configuration, for the
    message.
    """
    if calibration.plane.point is not None or calibration.plane.kind == "aperture":
        return
    if calibration.unit == "pix" and scale_arcsec is None:
        return  # the size of the field on the sky is unknown
    worst = departure_from_tangent_plane(calibration, epoch, scale_arcsec)
    if worst > MAX_DEPARTURE:
        raise InputError(
            "the header is that of a tangent plane, and the position of u, v on the sky is not "
            f"given: in so wide a field other projections differ by {worst:.2g} px",
            where=where,
            do=f"if u, v are on a tangent plane, set {where}.crval (--option 'crval=[RA, Dec]' of "
            "convert); otherwise write a SIP header with linear axes, or the parameters",
        )


def in_arcsec(calibration: Calibration, pixel: float) -> Calibration:
    """Convert a calibration from pixels to arcseconds; `pixel` is the size of a pixel in arcsec."""
    solution, model = calibration.solution, calibration.model
    return replace(
        calibration,
        solution=solution.transformed(
            replace(model, unit="arcsec"),
            lambda theta: pixel * theta[..., : model.n_params],
            pixel * np.eye(model.n_params),
        ),
        after=tuple(
            replace(
                table,
                values=pixel * table.values,
                sigma=None if table.sigma is None else pixel * table.sigma,
            )
            for table in calibration.after
        ),
        inverses={},
        scale=None if calibration.scale is None else pixel * calibration.scale,
        further=scaled(calibration.further, pixel),
    )


def correlations(
    za: Complex, zb: Complex, basis: PolynomialBasis
) -> tuple[complex, complex, float]:
    """Covariances over a chip of A with B, of A with the mirror image of B, and of B with itself.

    `za` and `zb` (K,) are the Legendre coefficients of u + i v of the maps A and B.
    """
    weight = basis.mean_squares
    weight[0] = 0.0  # the mean is absorbed by the shift
    straight = complex(np.sum(weight * za * zb.conj()))
    flipped = complex(np.sum(weight * za * zb))
    return straight, flipped, float(weight @ np.abs(zb) ** 2)


def turn_between(
    za: Complex, zb: Complex, basis: PolynomialBasis, name: str
) -> tuple[complex, bool]:
    """Scale and rotation from B to A as one complex number, and True if B is mirrored first.

    `za` and `zb` are the coefficients (K,) of u + i v of A and B.

    Raises InputError, with the `name` of B, if B maps the chip to one point.
    """
    straight, flipped, norm = correlations(za, zb, basis)
    if norm == 0.0:
        raise InputError("has no linear part", where=name, do="check its coefficients")
    mirrored = bool(abs(flipped) > abs(straight))
    return complex((flipped if mirrored else straight) / norm), mirrored


def as_real(z: Complex) -> Float:
    """Convert coefficients (K,) of u + i v to real coefficients (2 K,), u before v."""
    return np.concatenate([z.real, z.imag])


def similarity_fields(z: Complex) -> Float:
    """Derivatives (2 K, 4) of coefficients with respect to shift_u, shift_v, scale and rotation."""
    unit_shift = np.zeros_like(z)
    unit_shift[0] = 1.0
    offsets = z.copy()
    offsets[0] = 0.0  # about the mean position, so that rotations do not shift
    return np.stack(
        [as_real(f) for f in (unit_shift, 1j * unit_shift, offsets, 1j * offsets)], axis=1
    )
