"""Drift of one solution in another, as for a filter with few exposures.

ACS ISR 2015-06, section 4.4.4: the time dependence is derived in one filter and applied to all.
Rates and steps are compared in the reference gauge, so that the orientations of the two catalogues
and first exposures do not matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.equations.scaled import scaled_inverse, unit_diagonal
from bayesdist.infer.solution.solution import DerivedSolution, Solution
from bayesdist.infer.solution.transforms import reference_gauge, without_frames
from bayesdist.model import DistortionModel
from bayesdist.model.similarity import turned, turned_model
from bayesdist.utils.arrays import Float
from bayesdist.utils.quantities import Random, generator_of


@dataclass(frozen=True, eq=False)
class SharedDrift(DerivedSolution):
    """A solution, without frames, whose drift is that of another one."""

    model: DistortionModel
    mean: Float
    cov: Float
    source: Solution  # the original solution, without frames
    reference: Solution  # solution that gives the drift
    gain: Float  # change of the polynomials with the drift (n_polynomial, n_tdd)
    matrix: Float  # from the reference in its gauge to this drift (n_tdd, D')

    def draws(self, n: int, rng: Random) -> Float:
        """Parameter vectors (n, D): draws of the source with draws of the reference's drift."""
        generator = generator_of(rng)
        theta = np.array(self.source.draws(n, generator), float)
        drift = np.asarray(self.reference.draws(n, generator), float) @ self.matrix.T
        k = self.model.n_polynomial
        theta[:, :k] += (drift - theta[:, k:]) @ self.gain.T
        theta[:, k:] = drift
        return theta


def with_drift_of(
    solution: Solution, reference: Solution, *, chip: int = 2, formal: Solution | None = None
) -> SharedDrift:
    """Solution with the drift of another one, and the polynomials that follow from it; no frames.

    Its own data, or priors, must determine all of its drift.  `chip` is the number of the reference
    chip.  The covariance of `formal` gives the change of the polynomials with the drift: the linear
    fit of a posterior, as that of a few thousand draws is noisy; the solution's own by default.

    The polynomials follow as under a Gaussian posterior: given the drift they do not depend on what
    the solution took its drift to be, neither from its data nor from a prior.  The information of
    its data about the drift is not used.

    InputError for solutions with other chips, units or reference dates, or without drift;
    DegenerateError when the covariance of the solution's drift is singular.
    """
    own = without_frames(solution)
    model = own.model
    gauge = reference_gauge(solution, chip).gauge
    there, matrix = _in_gauge(reference, model, chip, gauge.rotation)
    k = model.n_polynomial
    cov = np.asarray(own.cov, float)
    if not (np.diag(cov)[k:] > 0).all():
        raise DegenerateError(
            "the solution's drift has no error", where="model.tdd", do="fit it, or give it a prior"
        )
    exact = cov if formal is None else np.asarray(without_frames(formal).cov, float)
    gain = exact[:k, k:] @ scaled_inverse(exact[k:, k:])
    drift = matrix @ np.asarray(there.mean, float)
    spread = matrix @ np.asarray(there.cov, float) @ matrix.T
    mean = np.array(own.mean, float)
    mean[:k] += gain @ (drift - mean[k:])
    mean[k:] = drift
    total = np.empty_like(cov)
    cross = gain @ cov[k:, :k]
    total[:k, :k] = cov[:k, :k] - cross - cross.T + gain @ (spread + cov[k:, k:]) @ gain.T
    total[:k, k:] = gain @ spread
    total[k:, :k] = total[:k, k:].T
    total[k:, k:] = spread
    return SharedDrift(model, mean, (total + total.T) / 2, own, there, gain, matrix)


def drift_priors(
    reference: Solution, model: DistortionModel, *, chip: int = 2
) -> dict[str, tuple[float, float]]:
    """Independent priors (mean, sigma) on a model's rates and steps, by name, from a reference.

    The model's polynomials lie along the reference chip's axes, as `held_in_reference` lays them.
    InputError for solutions with other chips, units or reference dates, or without drift.

    The reference's covariance S has strong correlations: chips drift together.  Independent priors
    of variances k diag(S), with k the largest eigenvalue of the correlation matrix, are nowhere
    tighter than S: k diag(S) - S has no negative eigenvalue.  All that follows from them has an
    error that is too large rather than too small.  A rotation of the model against the reference
    chip by some 1e-5, as the first exposure's error leaves it, changes a rate by 1e-5 of another.
    """
    there, matrix = _in_gauge(reference, model, chip, 0.0)
    mean = matrix @ np.asarray(there.mean, float)
    cov = matrix @ np.asarray(there.cov, float) @ matrix.T
    correlation, sigma = unit_diagonal(cov)
    largest = float(np.linalg.eigvalsh(correlation)[-1])
    names = model.names[model.n_polynomial : model.n_distortion]
    pairs = zip(mean.tolist(), (np.sqrt(largest) * sigma).tolist(), strict=True)
    return dict(zip(names, pairs, strict=True))


def _in_gauge(
    reference: Solution, model: DistortionModel, chip: int, rotation: float
) -> tuple[Solution, Float]:
    """Reference in its gauge, and the matrix (n_tdd, D') from there to the drift of a model.

    `rotation` brings the model to the gauge.
    """
    _require_alike(reference.model, model)
    view = reference_gauge(reference, chip)
    # back by the rotation; drifts that this makes in terms that the model lacks are left out
    linear = turned(view.model, np.eye(view.model.n_params), np.exp(-1j * rotation), 0.0).T
    names = turned_model(view.model).names
    wanted = model.names[model.n_polynomial : model.n_distortion]
    return view, linear[[names.index(name) for name in wanted]]


def _require_alike(reference: DistortionModel, model: DistortionModel) -> None:
    """Raise InputError for drifts of models with different chips, units, terms or dates."""
    where = "model.tdd"
    if reference.time is None or model.time is None:
        raise InputError(
            "the reference solution does not drift"
            if reference.time is None
            else "the model does not drift",
            where=where,
            do="give both the same [model.tdd]",
        )
    missing = [term for term in model.time.terms if term not in reference.time.terms]
    if missing:
        raise InputError(
            f"the term {missing[0]} does not drift in the reference solution",
            where=f"{where}.terms",
            do="configure both alike",
        )
    for what, mine, theirs in (
        ("chips", model.chips, reference.chips),
        ("units", model.unit, reference.unit),
        ("reference dates", model.time.epoch0, reference.time.epoch0),
        ("breaks", model.time.breaks, reference.time.breaks),
    ):
        if mine != theirs:
            said = "" if what == "chips" else f": {mine} and, in the reference, {theirs}"
            raise InputError(
                f"the {what} are not those of the reference solution{said}",
                where=where,
                do="configure both alike",
            )
