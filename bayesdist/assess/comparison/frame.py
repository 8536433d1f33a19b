"""Common frame of two calibrations A and B, and differences between A and B in this frame.

**Whole detector.** With w = u + i v, and means over the area of the detector,

    w_A = shift + turn w_B + d        (or the conjugate of w_B if one of them is mirrored)

is solved for shift and turn by least squares. The residual d is the part that no shift, rotation or
scale explains. It is given along the axes of the detector in undistorted pixels of A, that is,
divided by the linear part of A.

Several chips are compared one by one, each after removing its best-fitting shift, rotation and
scale. A shift, rotation or scale of the frame applies to all chips in the same way, so the position
of one chip relative to another is compared separately.

**Gap between two chips.** The position of a chip relative to a reference chip is compared in A and
in B. The similarity (shift and turn) of the reference chip is removed from the whole detector. For
the other chip, then,

    w_A = shift + (1 + scale + i rotation) (turn w_B - its mean) + d

with shift, rotation and scale relative to the reference chip. They are linear in the coefficients
of both chips, so their errors propagate linearly.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from bayesdist.assess.units import convert
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.calibration.orientation import as_real, similarity_fields, turn_between
from bayesdist.errors import InputError
from bayesdist.infer.equations.scaled import FieldTest, chi_square
from bayesdist.model import PolynomialBasis
from bayesdist.model.alignment import term_squares
from bayesdist.utils.arrays import Complex, Float

NEAR = 0.1  # radians, or relative scale: largest difference of axes that count as parallel


@dataclass(frozen=True)
class FrameSimilarity:
    """Shift, rotation and scale between A and B: w_A = shift + turn w_B."""

    # mean over the detector of A minus B, along x and y, pixels; None unless the axes of A and B
    # are nearly parallel and their units agree
    shift: tuple[float, float] | None
    rotation: float  # radians, from u towards v
    scale: float  # of A relative to B; meaningless if one is in pixels and the other in angles
    mirrored: bool
    same_unit: bool  # True if both are in pixels or both in angles
    sigma_shift: tuple[float, float] | None
    # standard errors; None if neither side has a covariance, or one has no correlations
    sigma_rotation: float | None
    sigma_scale: float | None

    @property
    def alike(self) -> bool:
        """True if the axes of A and B are nearly parallel, so that shift and scale can differ."""
        turned = np.hypot(self.rotation, self.scale - 1.0)
        return self.same_unit and not self.mirrored and bool(turned < NEAR)


@dataclass(frozen=True, eq=False)
class CommonFrame:
    """The difference A - B in pixels of A, and what was removed from it."""

    basis: PolynomialBasis  # with the higher of the two orders and the reference pixel of A
    difference: Float  # (2, K), Legendre coefficients
    cov: Float | None  # (2 K, 2 K), covariance of the difference, u before v
    raw_cov: Float | None  # (2 K, 2 K), covariance before anything was removed
    # (2 K, q), fields of the shift, the scale and the rotation that were removed; q = 0 if they are
    # kept
    taken: Float
    shares: tuple[float, float]  # fractions that A and B contribute to the variances
    similarity: FrameSimilarity
    pixel_mas: float | None  # size of a pixel of A, if either side states it

    @property
    def norm(self) -> Float:
        """Mean square over the detector of each Legendre product, shape (2 K,), u before v."""
        return term_squares(self.basis)


def common_frame(a: ChipMap, b: ChipMap, *, keep: bool) -> CommonFrame:
    """Transform two calibrations to a common frame.

    `a`, `b`: calibrations of one detector, with any order, reference pixel, orientation, parity and
    unit. Their errors are treated as independent. `keep`: True to keep shift, rotation and scale in
    the difference. Raises InputError if the detectors differ in size, a calibration has no linear
    part, or shift, rotation and scale should be kept although the axes are not nearly parallel.
    """
    if a.basis.size != b.basis.size:
        sizes = " and ".join(f"{c.basis.size[0]:g} x {c.basis.size[1]:g}" for c in (a, b))
        raise InputError(
            f"the detectors have {sizes} pixels",
            where=f"{a.name}, {b.name}",
            do="compare calibrations of one detector",
        )
    order = max(a.basis.order, b.basis.order)
    basis = PolynomialBasis(order, a.basis.size, a.basis.reference_pixel)
    same_unit = (a.unit == "pix") == (b.unit == "pix")
    factor = convert(1.0, b.unit, a.unit) if same_unit else 1.0
    wa, cov_a = a.padded(basis.n_terms)
    wb, cov_b = b.padded(basis.n_terms)
    za, zb = wa[0] + 1j * wa[1], factor * (wb[0] + 1j * wb[1])
    turn, mirrored = turn_between(za, zb, basis, b.name)
    if mirrored:
        zb = zb.conj()
    linear = linear_part(basis, wa, a)
    to_pixels = np.kron(np.linalg.inv(linear), np.eye(basis.n_terms))

    lies_alike = same_unit and not mirrored and abs(turn - 1.0) < NEAR
    if keep and not lies_alike:
        raise InputError(
            "shift, rotation and scale are not meaningful differences between frames "
            + ("of other axes" if same_unit else f"in {a.unit} and in {b.unit}"),
            where=f"{a.name}, {b.name}",
            do="leave out --keep-linear",
        )
    used = 1.0 if keep else turn
    moved = used * zb
    of_b = turn_matrix(used, mirrored=mirrored) * factor
    parts = [] if cov_a is None else [cov_a]
    if cov_b is not None:
        change = np.kron(of_b, np.eye(basis.n_terms))
        parts.append(change @ cov_b @ change.T)
    cov = sum(parts[1:], parts[0]) if parts else None
    shares = (float(cov_a is not None), float(cov_b is not None))
    if cov is not None and len(parts) == 2:
        positive = np.diag(cov) > 0
        of_a = float(np.mean(np.diag(parts[0])[positive] / np.diag(cov)[positive]))
        shares = (of_a, 1.0 - of_a)

    fields = similarity_fields(moved)
    estimate = least_squares(fields, basis)
    raw = as_real(za - moved)
    errors = None
    if cov is not None and a.correlated and b.correlated:
        errors = estimate @ cov @ estimate.T
    removed = fields[:, :0] if keep else fields
    projector = np.eye(len(raw)) - (0.0 if keep else fields @ estimate)
    out = to_pixels @ projector
    return CommonFrame(
        basis=basis,
        difference=(out @ raw).reshape(2, -1),
        cov=None if cov is None else _symmetric(out @ cov @ out.T),
        raw_cov=None if cov is None else _symmetric(to_pixels @ cov @ to_pixels.T),
        taken=to_pixels @ removed,
        shares=shares,
        similarity=_similarity(turn, mirrored, same_unit, lies_alike, linear, za, zb, errors),
        pixel_mas=_pixel_mas(a, b, linear, turn),
    )


def with_errors(a: Float | None, b: Float | None) -> str:
    """Calibrations with a covariance: 'both', 'A', 'B' or 'none'."""
    if a is not None:
        return "A" if b is None else "both"
    return "none" if b is None else "B"


def draws_of_sum(parts: Iterable[tuple[float, ChipMap]]) -> float:
    """Effective number of draws of a sum of estimated covariances (Welch-Satterthwaite formula).

    `parts`: for each estimate its fraction of the sum, and the map that states its number of draws.
    """
    lost = sum(share**2 / chip_map.draws for share, chip_map in parts)
    return 1.0 / lost if lost > 0 else np.inf


def turn_matrix(turn: complex, *, mirrored: bool) -> Float:
    """Matrix (2, 2) of a scale and rotation, applied after a reflection if `mirrored`.

    `turn` is the product of the scale and exp(i angle).
    """
    matrix = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    return matrix * np.array([1.0, -1.0]) if mirrored else matrix


def least_squares(fields: Float, basis: PolynomialBasis) -> Float:
    """Matrix (q, 2 K) that fits fields (2 K, q) to a difference by least squares over the chip."""
    weighted = fields * term_squares(basis)[:, None]
    return np.asarray(np.linalg.solve(fields.T @ weighted, weighted.T))


def linear_part(basis: PolynomialBasis, coefficients: Float, a: ChipMap) -> Float:
    """Derivatives (2, 2) of A's positions with respect to the pixel, at its reference pixel.

    `coefficients` (2, K) are those of A for the `basis`.  Raises InputError if the matrix is
    singular.
    """
    linear = basis.to_monomials(coefficients)[:, 1:3]
    if abs(np.linalg.det(linear)) <= 1e-9 * np.abs(linear).max() ** 2:
        raise InputError("has a singular linear part", where=a.name, do="check its coefficients")
    return linear


def _symmetric(cov: Float) -> Float:
    return (cov + cov.T) / 2


def _similarity(
    turn: complex,
    mirrored: bool,
    same_unit: bool,
    lies_alike: bool,
    linear: Float,
    za: Complex,
    zb: Complex,
    errors: Float | None,
) -> FrameSimilarity:
    inverse = np.linalg.inv(linear)
    shift = inverse @ as_real((za - zb)[:1])
    sigma = None
    sigma_shift: tuple[float, float] | None = None
    if errors is not None:
        sigma = np.sqrt(np.maximum(np.diag(errors), 0.0))
        shift_cov = inverse @ errors[:2, :2] @ inverse.T
        along_u, along_v = np.sqrt(np.maximum(np.diag(shift_cov), 0.0)).tolist()
        sigma_shift = along_u, along_v
    return FrameSimilarity(
        shift=(float(shift[0]), float(shift[1])) if lies_alike else None,
        rotation=float(np.angle(turn)),
        scale=abs(turn),
        mirrored=mirrored,
        same_unit=same_unit,
        sigma_shift=sigma_shift if lies_alike else None,
        sigma_rotation=None if sigma is None else float(sigma[3]),
        sigma_scale=None if sigma is None else float(sigma[2] * abs(turn)),
    )


def _pixel_mas(a: ChipMap, b: ChipMap, linear: Float, turn: complex) -> float | None:
    pixel = float(np.sqrt(abs(np.linalg.det(linear))))  # in the unit of A
    if a.unit != "pix":
        return convert(pixel, a.unit, "mas")
    if b.unit != "pix":
        return convert(pixel / abs(turn), b.unit, "mas")
    return None


@dataclass(frozen=True, eq=False)
class ChipPair:
    """Two chips of one calibration in a common plane."""

    chips: tuple[int, int]  # numbers of the reference chip and of the other chip
    reference: ChipMap  # both maps have the same order and the same system of u, v
    other: ChipMap
    # (4 K, 4 K), joint covariance of their coefficients: u and v of the reference chip, followed by
    # u and v of the other chip
    cov: Float | None


@dataclass(frozen=True, eq=False)
class GapDifference:
    """Offset of a chip, A minus B, after aligning the reference chips."""

    chip: int  # chip numbers
    reference: int
    # (4,), mean shift over the chip along its x and y, in undistorted pixels of A; scale; rotation
    # from u towards v, radians
    values: Float
    cov: Float | None  # (4, 4)
    test: FieldTest | None  # of all four values combined; None without errors on either side
    errors_of: str  # 'both', 'A', 'B' or 'none'; see `with_errors`

    @property
    def sigma(self) -> Float | None:
        """Standard errors (4,) of `values`; None if neither side has errors."""
        return None if self.cov is None else np.sqrt(np.maximum(np.diag(self.cov), 0.0))


def pair_of_chips(
    calibration: Calibration, reference: int, other: int, *, epoch: float | None = None
) -> ChipPair:
    """Two chips of a calibration.

    `reference`, `other`: chip numbers. `epoch`: decimal years, if the calibration depends on time.
    The result has a covariance if the calibration has one.
    """
    maps = calibration.at(epoch, origin="stated")
    cov = calibration.joint_covariance((reference, other), epoch, origin="stated")
    return ChipPair((reference, other), maps[reference], maps[other], cov)


def gap_difference(a: ChipPair, b: ChipPair) -> GapDifference:
    """Compare the position of a chip relative to another one in two calibrations.

    `a`, `b`: pairs of the same chips, already compared by `compare`, with any order, reference
    pixel, orientation, parity and unit. Their errors are treated as independent. Raises InputError
    if a chip has no linear part.
    """
    bases = []
    for of_a, of_b in ((a.reference, b.reference), (a.other, b.other)):
        order = max(of_a.basis.order, of_b.basis.order)
        bases.append(PolynomialBasis(order, of_a.basis.size, of_a.basis.reference_pixel))
    K = bases[0].n_terms
    coefficients = [[c.padded(K)[0] for c in (pair.reference, pair.other)] for pair in (a, b)]
    za, zb = ([c[0] + 1j * c[1] for c in pair_coefficients] for pair_coefficients in coefficients)
    turn, mirrored = turn_between(za[0], zb[0], bases[0], b.reference.name)
    moved = [turn * (z.conj() if mirrored else z) for z in zb]
    raw = [as_real(x - y) for x, y in zip(za, moved, strict=True)]
    fits = [
        least_squares(similarity_fields(z), basis) for z, basis in zip(moved, bases, strict=True)
    ]
    # effect on the other chip of the similarity fitted to the reference chip
    about = moved[1].copy()
    about[0] -= moved[0][0]
    constant = np.zeros_like(about)
    constant[0] = 1.0
    carried = np.stack([as_real(f) for f in (constant, 1j * constant, about, 1j * about)], axis=1)
    linear = np.eye(4)
    linear[:2, :2] = np.linalg.inv(linear_part(bases[1], coefficients[0][1], a.other))
    estimate = linear @ np.hstack([-fits[1] @ carried @ fits[0], fits[1]])
    values = estimate @ np.concatenate(raw)

    turned = np.kron(turn_matrix(turn, mirrored=mirrored), np.eye(K))
    change = np.kron(np.eye(2), turned)
    errors = [
        by @ _padded(pair.cov, pair.reference.basis.n_terms, K) @ by.T
        for pair, by in ((a, estimate), (b, estimate @ change))
        if pair.cov is not None
    ]
    reference, other_chip = a.chips
    cov = sum(errors[1:], errors[0]) if errors else None
    return GapDifference(
        other_chip,
        reference,
        values,
        cov,
        None if cov is None else _test(values, cov, errors, (a, b), bases[1]),
        with_errors(a.cov, b.cov),
    )


def _test(
    values: Float,
    cov: Float,
    errors: list[Float],
    pairs: tuple[ChipPair, ChipPair],
    basis: PolynomialBasis,
) -> FieldTest:
    """Chi-square of all four values, each weighted by its effect at the edge of the chip."""
    lever = float(np.hypot(*basis.half_size))
    norm = np.array([1.0, 1.0, lever, lever]) ** 2
    maps = [pair.other for pair in pairs if pair.cov is not None]
    shares = [float(np.mean(np.diag(e) / np.diag(cov))) for e in errors]
    draws = draws_of_sum(zip(shares, maps, strict=True))
    return chi_square(values, cov, norm=norm, draws=draws)


def _padded(cov: Float, K: int, n_terms: int) -> Float:
    """Joint covariance of K terms of two chips, padded with zeros to `n_terms`."""
    out = np.zeros((4, n_terms, 4, n_terms))
    out[:, :K, :, :K] = cov.reshape(4, K, 4, K)
    return out.reshape(4 * n_terms, -1)
