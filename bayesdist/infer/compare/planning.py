"""What more data would do to a solution: Fisher information of exposures not yet taken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.matches import MatchTable
from bayesdist.errors import InputError
from bayesdist.infer.equations.scaled import scaled_cholesky, scaled_inverse
from bayesdist.infer.posterior.recoloured import Recoloured
from bayesdist.infer.transforms import Solution
from bayesdist.model import DistortionModel

__all__ = ["ExposureContent", "exposure_content", "exposure_information", "with_information"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ExposureContent:
    """What the stars of an average exposure tell of polynomials on each chip.

    Parameters
    ----------
    moments : dict of int to ndarray, shape (2, K, K)
        By chip number: sums over the stars of weight times products of basis functions, of each
        axis.
    n_stars : float
    """

    moments: dict[int, Float]
    n_stars: float


def exposure_content(
    model: DistortionModel,
    matches: MatchTable,
    weight: ArrayLike,
    *,
    n_total: int | None = None,
    n_exposures: int = 1,
) -> ExposureContent:
    """The average exposure of some data.

    Parameters
    ----------
    model : DistortionModel
    matches : MatchTable
        All stars, or some that stand for all.
    weight : array_like, shape (N, 2)
        Inverse variances of both axes times the probability that the match is true.
    n_total : int, optional
        Stars that there are in all.
    n_exposures : int, optional

    Returns
    -------
    ExposureContent
    """
    weight = np.asarray(weight, float)
    K = model.n_terms
    moments = {}
    numbers = np.asarray(matches.chip_numbers)[matches.chip]
    share = (n_total or len(matches)) / len(matches) / n_exposures
    for chip in model.chips:
        on = numbers == chip.number if len(model.chips) > 1 else np.ones(len(matches), bool)
        phi = model.basis(chip.number).evaluate(matches.x[on], matches.y[on])
        moments[chip.number] = share * np.stack(
            [(phi * w[:, None]).T @ phi for w in weight[on].T]
        ).reshape(2, K, K)
    return ExposureContent(moments, share * len(matches))


def exposure_information(
    solution: Solution,
    content: ExposureContent,
    epoch: float | None,
    *,
    scatter: Mapping[str, float] | None = None,
) -> Float:
    """Fisher information of one more exposure about polynomials and drift.

    The exposure's own frame is fitted as that of the others; what it leaves open is eliminated.

    Parameters
    ----------
    solution : Solution
        Where the model is linearised.
    content : ExposureContent
    epoch : float or None
        Decimal years; needed by a model with time dependence.
    scatter : mapping of str to float, optional
        How deviations of exposures, by the names of their parameters, scatter: those are no free
        parameters.  Free where not named.

    Returns
    -------
    ndarray, shape (d, d)
        Of the model's first d = `n_distortion` parameters.
    """
    model = solution.model
    D, last = model.n_params, len(model.exposures) - 1
    exposure = last if model.n_frame else None
    H = np.zeros((D, D))
    for chip in model.chips:
        group = model.groups(1, epoch=epoch, exposure=exposure, chip=chip.number)
        [(columns, d)] = model.effective_jacobian(np.asarray(solution.mean), group)
        part = np.einsum("akm,akl,aln->mn", d, content.moments[chip.number], d, optimize=True)
        H[np.ix_(columns, columns)] += part
    n = model.n_distortion
    if exposure is None:
        return H[:n, :n]
    block = model.frame_slice(exposure)
    local = H[block, block].copy()
    for k, name in enumerate(model.free_frame_names(exposure)):
        tau = (scatter or {}).get(name)
        if tau is not None:
            local[k, k] += 1.0 / max(tau, 1e-300) ** 2
    if not np.any(local):
        return H[:n, :n]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(local), 1e-300))
    cross = H[:n, block] * scale
    return H[:n, :n] - cross @ np.linalg.solve(local * np.outer(scale, scale), cross.T)


def with_information(solution: Solution, information: Float) -> Recoloured:
    """A solution as it would be with more information about polynomials and drift.

    Frames of the exposures that are there change as far as they are correlated with these.

    Parameters
    ----------
    solution : Solution
    information : ndarray, shape (d, d)
        As of `exposure_information`, or a sum of such.

    Returns
    -------
    Recoloured

    Raises
    ------
    InputError
        For information of another number of parameters.
    """
    n = solution.model.n_distortion
    if information.shape != (n, n):
        raise InputError(
            f"the information is of shape {information.shape} for {n} parameters",
            do="give that of the polynomials and their drift",
        )
    cov = np.asarray(solution.cov, float)
    # (C^-1 + H)^-1 without inverting C, which may be nearly singular
    root = scaled_cholesky(cov[:n, :n])
    inner = np.eye(n) + root.T @ information @ root
    after = root @ np.linalg.solve(inner, root.T)
    follow = cov[:, :n] @ scaled_inverse(cov[:n, :n])
    changed = cov + follow @ (after - cov[:n, :n]) @ follow.T
    return Recoloured(solution, (changed + changed.T) / 2)
