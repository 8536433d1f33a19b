"""The drift of one solution in another: what a filter with few exposures takes from the reference.

ACS ISR 2015-06, section 4.4.4: the time dependence is derived in one filter and applied to all.
Rates and steps are compared in the reference gauge, so that it does not matter how the catalogues
or the first exposures of the two solutions lay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.equations.scaled import scaled_inverse, unit_diagonal
from bayesdist.infer.transforms import Derived, Solution, reference_gauge, without_frames
from bayesdist.model import DistortionModel
from bayesdist.model.similarity import turned, turned_model

__all__ = ["SharedDrift", "drift_priors", "with_drift_of"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SharedDrift(Derived):
    """A solution whose drift is that of another one.

    Parameters
    ----------
    model : DistortionModel
        Without frames.
    mean : ndarray, shape (D,)
    cov : ndarray, shape (D, D)
    source : Solution
        As it was, without frames.
    reference : Solution
        Whose drift it is.
    gain : ndarray, shape (n_polynomial, n_tdd)
        Change of the polynomials with the drift.
    matrix : ndarray, shape (n_tdd, D')
        From the reference in its gauge to the drift of this one.
    """

    model: DistortionModel
    mean: Float
    cov: Float
    source: Solution
    reference: Solution
    gain: Float
    matrix: Float

    def draws(self, n: int, rng: np.random.Generator) -> Float:
        """Parameter vectors (n, D): each draw of the source with a draw of the reference's drift.

        Parameters
        ----------
        n : int
        rng : numpy.random.Generator
        """
        theta = np.array(self.source.draws(n, rng), float)
        drift = np.asarray(self.reference.draws(n, rng), float) @ self.matrix.T
        k = self.model.n_polynomial
        theta[:, :k] += (drift - theta[:, k:]) @ self.gain.T
        theta[:, k:] = drift
        return theta


def with_drift_of(
    solution: Solution, reference: Solution, *, chip: int = 2, formal: Solution | None = None
) -> SharedDrift:
    """Give a solution the drift of another one, and the polynomials that go with it.

    Parameters
    ----------
    solution : Solution
        Its own data, or priors, must determine all of its drift.
    reference : Solution
    chip : int
        Number of the reference chip.
    formal : Solution, optional
        Whose covariance tells how the polynomials go with the drift: the linear fit of a posterior,
        as that of a few thousand draws is noisy.  The solution's own by default.

    Returns
    -------
    SharedDrift
        Without frames.

    Raises
    ------
    InputError
        For solutions with other chips, units or reference dates, or without drift.
    DegenerateError
        When the covariance of the solution's drift is singular.

    Notes
    -----
    The polynomials follow as under a Gaussian posterior: given the drift they do not depend on what
    the solution took its drift to be, neither from its data nor from a prior.  What its data say of
    the drift is not used.
    """
    own = without_frames(solution)
    model = own.model
    gauge = reference_gauge(solution, chip).gauge
    assert gauge is not None
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
    """Priors on rates and steps from another solution, as independent ones may stand for them.

    Parameters
    ----------
    reference : Solution
    model : DistortionModel
        Whose drift is to have priors; its polynomials lie along the reference chip's axes, as
        `held_in_reference` lays them.
    chip : int
        Number of the reference chip.

    Returns
    -------
    dict of str to (mean, sigma)
        By the names of the parameters.

    Raises
    ------
    InputError
        For solutions with other chips, units or reference dates, or without drift.

    Notes
    -----
    The reference's covariance S has strong correlations: chips drift together.  Independent priors
    of variances k diag(S), with k the largest eigenvalue of the correlation matrix, are nowhere
    tighter than S: k diag(S) - S has no negative eigenvalue.  Whatever follows from them is stated
    with an error that is too large rather than too small.  A rotation of the model against the
    reference chip by some 1e-5, as the first exposure's error leaves it, changes a rate by 1e-5 of
    another.
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
    """The reference in its gauge, and the matrix (n_tdd, D') from there to the drift of a model.

    `rotation` is that which brings the model to the gauge.
    """
    _require_alike(reference.model, model)
    view = reference_gauge(reference, chip)
    # back by the rotation; drifts that this makes in terms that the model lacks are left out
    linear = turned(view.model, np.eye(view.model.n_params), np.exp(-1j * rotation), 0.0).T
    names = turned_model(view.model).names
    wanted = model.names[model.n_polynomial : model.n_distortion]
    return view, linear[[names.index(name) for name in wanted]]


def _require_alike(reference: DistortionModel, model: DistortionModel) -> None:
    """Drifts can be taken over between models of the same chips, unit, terms and dates only."""
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
