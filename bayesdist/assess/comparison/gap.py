"""Gap between chips: compare the relative position of two chips in A and in B.

Chips are compared one by one, each after removing its best-fitting shift, rotation and scale. These
apply to all chips in the same way. After the similarity of the reference chip has been removed from
the whole detector, w = u + i v of another chip is

    w_A = shift + (1 + scale + i rotation) (turn w_B - its mean) + d

with shift, rotation and scale of the chip relative to the reference chip. They are linear in the
coefficients of both chips, and so are their errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.assess.comparison.frame import (
    draws_of_sum,
    least_squares,
    linear_part,
    turn_matrix,
    with_errors,
)
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.calibration.orientation import as_real, similarity_fields, turn_between
from bayesdist.infer.equations.scaled import FieldTest, chi_square
from bayesdist.model import PolynomialBasis
from bayesdist.utils.arrays import Float


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
        """Standard errors (4,)."""
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
