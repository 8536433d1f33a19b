"""Improvement of a solution by future exposures, from their Fisher information."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, overload

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.equations.scaled import recolouring, scaled_cholesky, scaled_inverse
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float

if TYPE_CHECKING:
    from bayesdist.infer.posterior import Posterior


@dataclass(frozen=True, eq=False)
class ExposureContent:
    """Information of the stars of an average exposure about the polynomials of each chip."""

    # sums (2, K, K) over the stars of weight times products of basis functions, for each axis; by
    # chip number
    moments: dict[int, Float]
    n_stars: float  # number of stars in the exposure


def exposure_content(
    model: DistortionModel,
    matches: Matches,
    weight: ArrayLike,
    *,
    n_total: int | None = None,
    n_exposures: int = 1,
) -> ExposureContent:
    """Compute the average content of `n_exposures` exposures.

    `matches` are all their stars, or a sample from `n_total` stars; `weight` (N, 2) is the inverse
    variance in u and v times the probability that the match is true.
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
) -> Float:
    """Fisher information (d, d) of one additional exposure about polynomials and drift.

    The model is linearised at the solution, and d is its `n_distortion`.  `epoch` (decimal years)
    is required if the model depends on time.  The frame of the exposure is assumed to be fitted;
    its parameters are eliminated.
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
    local = H[block, block]
    if not np.any(local):
        return H[:n, :n]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(local), 1e-300))
    cross = H[:n, block] * scale
    return H[:n, :n] - cross @ np.linalg.solve(local * np.outer(scale, scale), cross.T)


@overload
def with_information(solution: Posterior, information: Float) -> Posterior: ...
@overload
def with_information(solution: Solution, information: Float) -> Solution: ...
def with_information(solution: Solution, information: Float) -> Solution:
    """Add information (d, d) about polynomials and drift to a solution.

    The covariance of the existing exposures' frames changes according to its correlation with
    these, unless the information is about all parameters, (D, D).  Raises InputError if the shape
    of the information does not match the model.
    """
    n, known = len(information), (solution.model.n_distortion, solution.model.n_params)
    if information.shape != (n, n) or n not in known:
        raise InputError(
            f"the information has shape {information.shape} for {known[0]} parameters",
            do="give that of the polynomials and their drift, or of all parameters",
        )
    cov = np.asarray(solution.cov, float)
    # (C^-1 + H)^-1 without inverting C, which may be nearly singular
    root = scaled_cholesky(cov[:n, :n])
    inner = np.eye(n) + root.T @ information @ root
    after = root @ np.linalg.solve(inner, root.T)
    free = np.flatnonzero(np.diag(cov[:n, :n]) > 0)  # parameters not fixed by a gauge
    follow = np.zeros((len(cov), n))
    follow[:, free] = cov[:, free] @ scaled_inverse(cov[np.ix_(free, free)])
    changed = cov + follow @ (after - cov[:n, :n]) @ follow.T
    return solution.mapped(recolouring(cov, (changed + changed.T) / 2))
