"""The gap between chips: does one lie elsewhere against another in A than in B?

Chips are compared one by one, each after its own best shift, rotation and scale.  What these do to
one chip they have to do to all of them: with the similarity of the reference chip taken out of the
whole detector, w = u + i v of another chip is

    w_A = shift + (1 + scale + i rotation) (turn w_B - its mean) + d

in which shift, rotation and scale are those of the chip against the reference chip.  They are
linear in the coefficients of both chips, and so are their errors.
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
    """Two chips of one calibration in one plane."""

    chips: tuple[int, int]  # numbers of the reference chip and of the other one
    reference: ChipMap  # of one order, in one system of u, v
    other: ChipMap
    # (4 K, 4 K), joint covariance of their coefficients: u and v of the reference chip, then of the
    # other
    cov: Float | None


@dataclass(frozen=True, eq=False)
class GapDifference:
    """Offset of another chip, A minus B, where the reference chips lie on each other."""

    chip: int  # chip numbers
    reference: int
    # (4,), mean shift over the chip along its x and y, in pixels of A without distortion; scale;
    # rotation from u towards v, radians
    values: Float
    cov: Float | None  # (4, 4)
    test: FieldTest | None  # of all four at once; None without errors on either side
    errors_of: str  # 'both', 'A', 'B' or 'none': as of `with_errors`

    @property
    def sigma(self) -> Float | None:
        """Standard errors (4,)."""
        return None if self.cov is None else np.sqrt(np.maximum(np.diag(self.cov), 0.0))


def pair_of_chips(
    calibration: Calibration, reference: int, other: int, *, epoch: float | None = None
) -> ChipPair:
    """Two chips of a calibration.

    `reference`, `other`: chip numbers. `epoch`: decimal years, for what depends on time. The result
    comes with a covariance where the calibration has one.
    """
    maps = calibration.at(epoch, origin="stated")
    cov = calibration.joint_covariance((reference, other), epoch, origin="stated")
    return ChipPair((reference, other), maps[reference], maps[other], cov)


def gap_difference(a: ChipPair, b: ChipPair) -> GapDifference:
    """Compare where two calibrations have a chip against another one.

    `a`, `b`: of the same chips, which `compare` has compared; of any order, reference pixel,
    orientation, parity and unit.  Their errors are taken as independent. InputError for chips
    without linear part.
    """
    bases = []
    for of_a, of_b in ((a.reference, b.reference), (a.other, b.other)):
        order = max(of_a.basis.order, of_b.basis.order)
        bases.append(PolynomialBasis(order, of_a.basis.size, of_a.basis.reference_pixel))
    K = bases[0].n_terms
    both = [[c.padded(K)[0] for c in (pair.reference, pair.other)] for pair in (a, b)]
    za, zb = ([c[0] + 1j * c[1] for c in one] for one in both)
    turn, mirrored = turn_between(za[0], zb[0], bases[0], b.reference.name)
    moved = [turn * (z.conj() if mirrored else z) for z in zb]
    raw = [as_real(x - y) for x, y in zip(za, moved, strict=True)]
    fits = [
        least_squares(similarity_fields(z), basis) for z, basis in zip(moved, bases, strict=True)
    ]
    # what the similarity of the reference chip does to the other one
    about = moved[1].copy()
    about[0] -= moved[0][0]
    one = np.zeros_like(about)
    one[0] = 1.0
    carried = np.stack([as_real(f) for f in (one, 1j * one, about, 1j * about)], axis=1)
    linear = np.eye(4)
    linear[:2, :2] = np.linalg.inv(linear_part(bases[1], both[0][1], a.other))
    estimate = linear @ np.hstack([-fits[1] @ carried @ fits[0], fits[1]])
    values = estimate @ np.concatenate(raw)

    turned = np.kron(turn_matrix(turn, mirrored=mirrored), np.eye(K))
    change = np.kron(np.eye(2), turned)
    errors = [
        by @ _padded(pair.cov, pair.reference.basis.n_terms, K) @ by.T
        for pair, by in ((a, estimate), (b, estimate @ change))
        if pair.cov is not None
    ]
    reference, other = a.chips
    cov = sum(errors[1:], errors[0]) if errors else None
    return GapDifference(
        other,
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
    """Chi-square of all four, each as what it does to a star at the edge of the chip."""
    lever = float(np.hypot(*basis.half_size))
    norm = np.array([1.0, 1.0, lever, lever]) ** 2
    known = [pair.other for pair in pairs if pair.cov is not None]
    shares = [float(np.mean(np.diag(e) / np.diag(cov))) for e in errors]
    draws = draws_of_sum(zip(shares, known, strict=True))
    return chi_square(values, cov, norm=norm, draws=draws)


def _padded(cov: Float, K: int, n_terms: int) -> Float:
    """Joint covariance of K terms of two chips, with zeros for terms that are not there."""
    out = np.zeros((4, n_terms, 4, n_terms))
    out[:, :K, :, :K] = cov.reshape(4, K, 4, K)
    return out.reshape(4 * n_terms, -1)
