"""Transformations of a solution: gauges, one exposure, one time segment, linear terms.

The draws of a transformed solution are the transformed draws of its source.  Its covariance is
propagated with the exact Jacobian of the transformation at the mean.
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
from bayesdist.model.alignment import turned, turned_model
from bayesdist.model.effective import Groups
from bayesdist.utils.arrays import Complex, Float

# constant, x and y terms of both axes, as in Kozhurina-Platais et al. (2015, Equations 1-2)
LINEAR_TERMS = ("A_1", "A_2", "A_3", "B_1", "B_2", "B_3")
MAX_NAMES = 12  # number of exposures listed in an error message


@dataclass(frozen=True, eq=False)
class LinearTerms:
    """Constant and linear monomial coefficients with their covariance.

    Parameters
    ----------
    labels : tuple of str
        Names in the notation of Kozhurina-Platais et al. (2015): 'A_1' is the constant term of u,
        'A_2' its coefficient of x, 'A_3' that of y; 'B_1', 'B_2' and 'B_3' belong to v. If there
        are several chips, the chip's name is prepended ('WFC1.A_2'). The suffix '.alpha' denotes
        the value at the reference date, '.beta' the rate.
    values : ndarray, shape (k,)
        Coefficients: in the unit of u, v for constants, per pixel for linear terms, and per year
        for rates.
    cov : ndarray, shape (k, k)
        Covariance of `values`.
    """

    labels: tuple[str, ...]
    values: Float
    cov: Float

    @property
    def sigma(self) -> Float:
        """Standard deviation (k,) of each term."""
        return root_of_diagonal(self.cov)

    def select(self, *labels: str) -> LinearTerms:
        """Select terms by label.

        Parameters
        ----------
        *labels : str
            Labels of the terms, in the order of the result.

        Returns
        -------
        LinearTerms

        Raises
        ------
        InputError
            If a label is unknown.
        """
        unknown = [label for label in labels if label not in self.labels]
        if unknown:
            raise InputError(
                f"there is no term {unknown[0]!r}", do=f"choose among {', '.join(self.labels)}"
            )
        index = [self.labels.index(label) for label in labels]
        return LinearTerms(labels, self.values[index], self.cov[np.ix_(index, index)])


def bare_model(model: DistortionModel) -> DistortionModel:
    """Model with the polynomials and their drift only: the first parameters of the full model."""
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
    """Remove the exposure frames from a solution.

    Parameters
    ----------
    solution : Solution

    Returns
    -------
    TransformedSolution
        The polynomials and their drift. With gauge 'first' these are the polynomials of the first
        exposure, with gauge 'held' those from which all exposures deviate.
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
    """Polynomials of one exposure at one date, with its frame applied.

    Parameters
    ----------
    solution : Solution
    exposure : str, optional
        Name of an exposure of the model.  By default no frame is applied.
    epoch : float, optional
        Date in decimal years; required if the model depends on time.
    chips : sequence of int, optional
        Numbers of the chips of the result; all chips by default.

    Returns
    -------
    TransformedSolution
        Solution of a model without frames and time dependence.  Its covariance includes the
        uncertainty of the frame, and its draws correspond to those of `solution`.

    Raises
    ------
    InputError
        If the exposure or chip does not exist, or if the epoch is missing.
    """
    model = solution.model
    if exposure is not None and (not model.n_frame or exposure not in model.exposures):
        names, n_unlisted = model.exposures[:MAX_NAMES], len(model.exposures) - MAX_NAMES
        listed = ", ".join(names) + (f" and {n_unlisted} more" if n_unlisted > 0 else "")
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
    """Select the first n parameters.  A class, because nested functions cannot be pickled."""

    n: int

    def __call__(self, theta: Float) -> Float:
        return theta[..., : self.n]


@dataclass(frozen=True, eq=False)
class _EffectivePolynomials:
    """Compute the effective coefficients of groups of stars and concatenate them."""

    model: DistortionModel
    groups: tuple[Groups, ...]  # one per chip

    def __call__(self, theta: Float) -> Float:
        parts = [self.model.effective(theta, group) for group in self.groups]
        n_params = len(parts) * 2 * self.model.n_terms
        return np.concatenate(parts, axis=-3).reshape(*theta.shape[:-1], n_params)


def segment(solution: Solution, s: int) -> TransformedSolution:
    """Convert one segment of the time dependence to a model without breaks.

    Parameters
    ----------
    solution : Solution
    s : int
        Number of the segment, starting from 0.

    Returns
    -------
    TransformedSolution
        Solution without frames; its coefficients are those at the segment's reference date.

    Raises
    ------
    InputError
        If the segment does not exist.
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

    This is the gauge of Kozhurina-Platais et al. (2015), section 4.2: the reference pixel of the
    chip maps to the origin, and there its columns are parallel to v.  All other chips are rotated
    and shifted with it, so that their coefficients contain the gap and the rotation between the
    chips.

    Parameters
    ----------
    solution : Solution
    chip : int
        Number of the reference chip.
    epoch : float, optional
        Date (decimal years) at which the gauge holds, if the polynomials depend on time; by default
        the reference date of the first segment.

    Returns
    -------
    GaugedSolution
        Solution without frames; its attribute `gauge` has the rotation and shift.  If a term drifts
        on one axis, the rotated model lets it drift on both axes.

    Raises
    ------
    InputError
        If the chip does not exist.
    """
    model = bare_model(solution.model)
    time = model.time
    if time is not None and epoch is None:
        epoch = time.epoch0[0]
    group = model.groups(1, epoch=epoch if time is not None else None, chip=chip)
    basis = model.basis(chip)
    n = model.n_params

    def pose(theta: Float) -> tuple[Float, Complex]:
        """Rotation (...) in radians and complex shift u + i v (...) to the reference gauge."""
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
    """Constant and linear monomial coefficients at a date.

    Monomials are powers of the pixel offsets from the chip's reference pixel.

    Parameters
    ----------
    solution : Solution
        Only its polynomials are used, without exposure frames.
    chip : int, optional
        Chip number. By default all chips, with their names prepended to the labels.
    epoch : float, optional
        Date in decimal years; required if the model depends on time.

    Returns
    -------
    LinearTerms
        A_1, A_2, A_3, B_1, B_2, B_3 of each chip.

    Raises
    ------
    InputError
        If the chip does not exist or the epoch is missing.
    """
    labels, jacobian = _linear_jacobian(solution.model, chip, epoch)
    return _linear(solution, labels, jacobian)


def lines(solution: Solution, s: int = 0, *, chip: int | None = None) -> LinearTerms:
    """Constant and linear monomial coefficients as straight lines in time.

    Parameters
    ----------
    solution : Solution
    s : int
        Number of the segment, starting from 0.
    chip : int, optional
        Chip number. By default all chips, with their names prepended to the labels.

    Returns
    -------
    LinearTerms
        Value at the reference date ('A_2.alpha') and rate per year ('A_2.beta') of each
        coefficient, as in Tables 1-3 of Kozhurina-Platais et al. (2015). Coefficients that do not
        drift have a rate of zero.

    Raises
    ------
    InputError
        If the chip or segment does not exist.
    """
    view = segment(solution, s)
    t0 = required(view.model.time, "the model has no drift").epoch0[0]
    labels, alpha = _linear_jacobian(view.model, chip, t0)
    _, later = _linear_jacobian(view.model, chip, t0 + 1.0)
    line_labels = tuple(f"{label}.{part}" for part in ("alpha", "beta") for label in labels)
    return _linear(view, line_labels, np.vstack([alpha, later - alpha]))


def _linear(solution: Solution, labels: tuple[str, ...], jacobian: Float) -> LinearTerms:
    n = jacobian.shape[1]
    cov = jacobian @ np.asarray(solution.cov, float)[:n, :n] @ jacobian.T
    return LinearTerms(labels, jacobian @ np.asarray(solution.mean, float)[:n], (cov + cov.T) / 2)


def gauge_free_matrix(model: DistortionModel, theta: Float, null: Float) -> Float:
    """Matrix S (D, D) that removes the part along free directions from a change of the parameters.

    Solutions of the same detections in different gauges differ by a move along directions that the
    detections do not determine.  Without such moves, errors are the same in all gauges; this is an
    S-transformation (Baarda 1973; Teunissen 1985).

    `null` (D, d) are the free directions, such as `Gauge.null`; S null = 0.  For a change d of the
    parameters, S d is d minus the combination of free directions that best fits the change of the
    positions, by least squares over the area of all chips in the first exposure.
    """
    D = model.n_params
    if not null.shape[1]:
        return np.eye(D)
    rows = []
    for chip in model.chips:
        x, y, area = chip.quadrature(model.order + 1)  # exact for squares of the polynomials
        identity = {"exposure": np.zeros(len(x), np.int64), "chip": np.full(len(x), chip.number)}
        if model.time is not None:
            identity["epoch"] = np.full(len(x), model.time.epoch0[0])
        J = model.jacobian(theta, x, y, **identity)
        rows.append((np.sqrt(area)[:, None, None] * J).reshape(-1, D))
    J = np.concatenate(rows)
    return np.asarray(np.eye(D) - null @ np.linalg.pinv(J @ null) @ J)


def gauge_free(solution: Solution, null: Float) -> Solution:
    """Solution with errors of relative positions only, and the same mean.

    Parameters
    ----------
    solution : Solution
    null : ndarray, shape (D, d)
        Directions that the detections do not determine, such as `Gauge.null`.

    Returns
    -------
    Solution
        Its errors do not include moves along these directions.
    """
    return solution.mapped(gauge_free_matrix(solution.model, solution.mean, null))


def _linear_jacobian(
    model: DistortionModel, chip: int | None, epoch: float | None
) -> tuple[tuple[str, ...], Float]:
    """Labels (k,) and the matrix (k, n) that maps the parameters to the linear terms."""
    bare = bare_model(model)
    labels: list[str] = []
    rows = []
    for bare_chip in bare.chips:
        if chip is not None and bare.chip_code(chip) != bare.chip_code(bare_chip.number):
            continue
        group = bare.groups(
            1, epoch=epoch if bare.time is not None else None, chip=bare_chip.number
        )
        # the terms are linear in the parameters, so the derivatives hold for any values
        [(columns, d)] = bare.effective_jacobian(np.zeros(bare.n_params), group)
        row = np.zeros((2, 3, bare.n_params))
        row[:, :, columns] = np.einsum(
            "kl,alm->akm", bare.basis(bare_chip.number).monomial_matrix[:3], d
        )
        rows.append(row.reshape(6, -1))
        named = chip is None and len(bare.chips) > 1
        labels += [f"{bare_chip.name}.{term}" if named else term for term in LINEAR_TERMS]
    return tuple(labels), np.vstack(rows)
