"""Transformed solutions: in the reference gauge, in one segment, term by term.

The result is a solution again: its draws are those of its source, transformed one by one, and its
covariance is the source's through the exact Jacobian of that transformation at the mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesdist.errors import InputError, required
from bayesdist.infer.solution.solution import (
    GaugedSolution,
    ReferenceGauge,
    Solution,
    TransformedSolution,
    root_of_diagonal,
)
from bayesdist.model import DistortionModel, TimeDependence
from bayesdist.model.grouping import Groups
from bayesdist.model.similarity import turned, turned_model
from bayesdist.utils.arrays import Complex, Float

# constant, x and y of both axes as ACS ISR 2015-06 numbers them (Equations 1-2)
LINEAR_TERMS = ("A_1", "A_2", "A_3", "B_1", "B_2", "B_3")
MAX_NAMES = 12  # exposures that an error message lists


@dataclass(frozen=True, eq=False)
class LinearTerms:
    """Monomial coefficients with their covariance, in the notation of ACS ISR 2015-06.

    Parameters
    ----------
    labels : tuple of str
        'A_1' is the constant of u, 'A_2' its term in x, 'A_3' in y; ``B_...`` are those of v.  The
        chip's name stands before it where there are several chips; '.alpha' (value at the reference
        date) or '.beta' (rate) stands after it.
    values : ndarray, shape (k,)
        In the unit of u, v, per pixel, per year.
    cov : ndarray, shape (k, k)
    """

    labels: tuple[str, ...]
    values: Float
    cov: Float

    @property
    def sigma(self) -> Float:
        """Standard deviation of each term."""
        return root_of_diagonal(self.cov)

    def select(self, *labels: str) -> LinearTerms:
        """Selected terms, in the order of the labels given.

        Raises
        ------
        InputError
            For an unknown label.
        """
        unknown = [label for label in labels if label not in self.labels]
        if unknown:
            raise InputError(
                f"there is no term {unknown[0]!r}", do=f"choose among {', '.join(self.labels)}"
            )
        index = [self.labels.index(label) for label in labels]
        return LinearTerms(labels, self.values[index], self.cov[np.ix_(index, index)])


def bare_model(model: DistortionModel) -> DistortionModel:
    """Model of the polynomials alone, whose parameters are the first ones of the full model."""
    return replace(
        model,
        frames="none",
        exposures=("1",),
        origin=(0.0, 0.0),
        gauge="first",
        held=(0.0, 0.0, 0.0),
        chip_deviations=False,
    )


def without_frames(solution: Solution) -> TransformedSolution:
    """The polynomials and their drift alone.

    Parameters
    ----------
    solution : Solution

    Returns
    -------
    TransformedSolution
        Of the polynomials as they are before the frames: those of the first exposure in gauge
        'first', those from which all exposures deviate in gauge 'held'.
    """
    n = solution.model.n_distortion
    return solution.transformed(bare_model(solution.model), _FirstParameters(n), np.eye(n))


def at_exposure(
    solution: Solution,
    *,
    exposure: str | None = None,
    epoch: float | None = None,
    chips: Sequence[int] | None = None,
) -> TransformedSolution:
    """Polynomials of one exposure at one date, with the frame of the exposure applied to them.

    Parameters
    ----------
    solution : Solution
    exposure : str, optional
        Name of an exposure of the model.  By default no frame is applied.
    epoch : float, optional
        Decimal years; needed by a model with time dependence.
    chips : sequence of int, optional
        Numbers of the chips of the result; all chips by default.

    Returns
    -------
    TransformedSolution
        Solution of a model without frames and without time dependence.  Its covariance contains
        that of the frame, and its draws are those of `solution`.

    Raises
    ------
    InputError
        If there is no such exposure or chip, or the epoch is missing.
    """
    model = solution.model
    if exposure is not None and (not model.n_frame or exposure not in model.exposures):
        names, more = model.exposures[:MAX_NAMES], len(model.exposures) - MAX_NAMES
        listed = ", ".join(names) + (f" and {more} more" if more > 0 else "")
        raise InputError(
            f"there is no exposure {exposure!r}",
            where="exposure",
            do=f"choose one of {listed}"
            if model.n_frame
            else "leave it out: the model has no frames of exposures",
        )
    if model.time is not None and epoch is None:
        raise InputError(
            "the model depends on time and no epoch is given",
            where="epoch",
            do="give it in decimal years",
        )
    codes = [model.chip_code(number) for number in chips or [c.number for c in model.chips]]
    groups = tuple(
        model.groups(1, epoch=epoch, exposure=exposure, chip=model.chips[code].number)
        for code in codes
    )
    bare = replace(bare_model(model), time=None, chips=tuple(model.chips[code] for code in codes))
    mean = np.asarray(solution.mean, float)
    jacobian = np.zeros((len(codes), 2, model.n_terms, mean.size))
    for row, group in zip(jacobian, groups, strict=True):
        [(columns, derivative)] = model.effective_jacobian(mean, group)
        row[:, :, columns] = derivative
    return solution.transformed(
        bare, _EffectivePolynomials(model, groups), jacobian.reshape(bare.n_params, -1)
    )


@dataclass(frozen=True)
class _FirstParameters:
    """The first n parameters.  A class, because a function inside a function cannot be pickled."""

    n: int

    def __call__(self, theta: Float) -> Float:
        return theta[..., : self.n]


@dataclass(frozen=True, eq=False)
class _EffectivePolynomials:
    """Effective coefficients of groups of stars, one after the other."""

    model: DistortionModel
    groups: tuple[Groups, ...]  # each of one chip

    def __call__(self, theta: Float) -> Float:
        parts = [self.model.effective(theta, group) for group in self.groups]
        n_params = len(parts) * 2 * self.model.n_terms
        return np.concatenate(parts, axis=-3).reshape(*theta.shape[:-1], n_params)


def segment(solution: Solution, s: int) -> TransformedSolution:
    """One segment of the time dependence, as a model without breaks, as one IDCTAB holds it.

    Parameters
    ----------
    solution : Solution
    s : int
        Number of the segment, from 0.

    Returns
    -------
    TransformedSolution
        Without frames; its coefficients are those at the segment's reference date.

    Raises
    ------
    InputError
        When the model has no such segment.
    """
    model = solution.model
    time = model.time
    if time is None or not 0 <= s < time.n_segments:
        raise InputError(
            f"there is no segment {s}",
            where="model.tdd",
            do="the model has none"
            if time is None
            else f"choose one of 0 to {time.n_segments - 1}",
        )
    new = replace(bare_model(model), time=TimeDependence(time.terms, (time.epoch0[s],)))
    jacobian = np.zeros((new.n_params, model.n_distortion))
    jacobian[: model.n_polynomial, : model.n_polynomial] = np.eye(model.n_polynomial)
    for chip in model.chips:
        old = model.tdd_slice(chip.number).start
        for t, (axis, _, _) in enumerate(time.terms):
            first = old + t * time.n_values
            jacobian[new.tdd_slice(chip.number).start + t, first + 2 * s] = 1.0
            if s:
                rows = model.coefficient_slice(chip.number, "uv".index(axis))
                jacobian[rows, first + 2 * s - 1] = model.drift_terms(chip.number)[t]
    n = model.n_distortion
    return solution.transformed(new, lambda theta: theta[..., :n] @ jacobian.T, jacobian)


def reference_gauge(
    solution: Solution, chip: int = 2, *, epoch: float | None = None
) -> GaugedSolution:
    """Rotate and shift (u, v) so that one chip has A_1 = B_1 = 0 and A_3 = 0.

    The gauge of ACS ISR 2015-06, section 4.2: at the chip's reference pixel there is neither an
    offset nor a rotation of the column direction against v.  All other chips are carried along, so
    that gap and rotation between them are in their coefficients.

    Parameters
    ----------
    solution : Solution
    chip : int
        Number of the reference chip.
    epoch : float, optional
        Where the polynomials depend on time: the date at which the gauge holds, the reference date
        of the first segment by default.

    Returns
    -------
    GaugedSolution
        Without frames; `gauge` has the rotation and shift.  A rotation makes a term that drifted on
        one axis drift on both, so both are in the model of the view.

    Raises
    ------
    InputError
        For an unknown chip.
    """
    model = bare_model(solution.model)
    time = model.time
    if time is not None and epoch is None:
        epoch = time.epoch0[0]
    group = model.groups(1, epoch=epoch if time is not None else None, chip=chip)
    basis = model.basis(chip)
    n = model.n_params

    def pose(theta: Float) -> tuple[Float, Complex]:
        """Rotation (...) and shift (...) that bring the polynomials to the gauge."""
        at = basis.to_monomials(model.effective(theta, group)[..., 0, :, :])
        return np.arctan2(at[..., 0, 2], at[..., 1, 2]), at[..., 0, 0] + 1j * at[..., 1, 0]

    def transform(theta: Float) -> Float:
        theta = theta[..., :n]
        angle, shift = pose(theta)
        turn = np.exp(1j * angle)
        return turned(model, theta, turn, -turn * shift)

    mean = np.asarray(solution.mean, float)[:n]
    angle, shift = pose(mean)
    turn = np.exp(1j * angle)
    [(columns, d)] = model.effective_jacobian(mean, group)
    by = np.zeros((2, model.n_terms, n))
    by[:, :, columns] = np.einsum("kl,alm->akm", basis.monomial_matrix, d)
    a3, b3 = basis.to_monomials(model.effective(mean, group)[0])[:, 2]
    by_pose = np.vstack([(b3 * by[0, 2] - a3 * by[1, 2]) / (a3**2 + b3**2), by[:, 0]])
    none = np.zeros(n)
    jacobian = turned(model, np.eye(n), turn, 0.0).T
    jacobian += np.outer(turned(model, mean, 1j * turn, -1j * turn * shift), by_pose[0])
    for axis, unit in enumerate((1.0, 1j)):
        jacobian += np.outer(turned(model, none, turn, -turn * unit), by_pose[1 + axis])
    view = solution.transformed(turned_model(model), transform, jacobian)
    sigma = root_of_diagonal(by_pose @ np.asarray(solution.cov, float)[:n, :n] @ by_pose.T)
    gauge = ReferenceGauge(
        chip=chip,
        epoch=epoch,
        rotation=float(angle),
        shift=(float(shift.real), float(shift.imag)),
        sigma_rotation=float(sigma[0]),
        sigma_shift=(float(sigma[1]), float(sigma[2])),
    )
    return GaugedSolution(view.model, view.mean, view.cov, view.source, view.transform, gauge)


def linear_terms(
    solution: Solution, chip: int | None = None, *, epoch: float | None = None
) -> LinearTerms:
    """Constant and linear terms at a date, as monomials of the pixel offsets.

    Parameters
    ----------
    solution : Solution
        Only its polynomials are used, without frames.
    chip : int, optional
        Chip number; all chips by default, with their names before the labels.
    epoch : float, optional
        Decimal years; needed by a model with time dependence.

    Returns
    -------
    LinearTerms
        A_1, A_2, A_3, B_1, B_2, B_3 of each chip.

    Raises
    ------
    InputError
        For an unknown chip or a missing epoch.
    """
    labels, jacobian = _linear_jacobian(solution.model, chip, epoch)
    return _linear(solution, labels, jacobian)


def lines(solution: Solution, s: int = 0, *, chip: int | None = None) -> LinearTerms:
    """Linear terms as lines in time: values at the reference date, and rates.

    Parameters
    ----------
    solution : Solution
    s : int
        Number of the segment, from 0.
    chip : int, optional
        Chip number; all chips by default.

    Returns
    -------
    LinearTerms
        'A_2.alpha' and 'A_2.beta' of each term, as in Tables 1-3 of ACS ISR 2015-06; terms that
        do not drift have a rate of zero.

    Raises
    ------
    InputError
        For an unknown chip or segment.
    """
    view = segment(solution, s)
    t0 = required(view.model.time, "the model has no drift").epoch0[0]
    labels, alpha = _linear_jacobian(view.model, chip, t0)
    _, later = _linear_jacobian(view.model, chip, t0 + 1.0)
    both = tuple(f"{label}.{part}" for part in ("alpha", "beta") for label in labels)
    return _linear(view, both, np.vstack([alpha, later - alpha]))


def _linear(solution: Solution, labels: tuple[str, ...], jacobian: Float) -> LinearTerms:
    n = jacobian.shape[1]
    cov = jacobian @ np.asarray(solution.cov, float)[:n, :n] @ jacobian.T
    return LinearTerms(labels, jacobian @ np.asarray(solution.mean, float)[:n], (cov + cov.T) / 2)


def _linear_jacobian(
    model: DistortionModel, chip: int | None, epoch: float | None
) -> tuple[tuple[str, ...], Float]:
    """Labels (k,) and the matrix (k, n) that maps the parameters to the linear terms."""
    bare = bare_model(model)
    labels: list[str] = []
    rows = []
    for one in bare.chips:
        if chip is not None and bare.chip_code(chip) != bare.chip_code(one.number):
            continue
        group = bare.groups(1, epoch=epoch if bare.time is not None else None, chip=one.number)
        # linear in the parameters, whatever their values
        [(columns, d)] = bare.effective_jacobian(np.zeros(bare.n_params), group)
        row = np.zeros((2, 3, bare.n_params))
        row[:, :, columns] = np.einsum("kl,alm->akm", bare.basis(one.number).monomial_matrix[:3], d)
        rows.append(row.reshape(6, -1))
        named = chip is None and len(bare.chips) > 1
        labels += [f"{one.name}.{term}" if named else term for term in LINEAR_TERMS]
    return tuple(labels), np.vstack(rows)
