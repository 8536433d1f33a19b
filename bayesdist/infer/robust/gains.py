"""What the scores of stars do to the parameters, with and without the frames of their exposures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.field_test import determined
from bayesdist.infer.prior import GaussianPriors
from bayesdist.infer.robust.sums import ClusterSums
from bayesdist.model import DistortionModel, Groups

__all__ = ["Gains", "gains"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Gains:
    """Derivatives of the parameters by scores, which are along the axes of the polynomials.

    Parameters
    ----------
    by_group : list of ndarray, shape (D, 2K)
        By the score of each group of stars.
    without_frame : list of ndarray, shape (D, 2K)
        The same, less what the frame of the group's exposure takes upon itself.
    by_exposure : list of ndarray, shape (D, 2K)
        By the score of a whole exposure: that along its frame, which balances the pull of the
        frame's prior, is left out.
    frame : list of ndarray, shape (2K, q)
        Of each chip a root F, for which F F^T is what frames take of the stars' errors: the same
        for all exposures, were each a share of the whole.  Empty where there are no frames.
    """

    by_group: list[Float]
    without_frame: list[Float]
    by_exposure: list[Float]
    frame: list[Float]


def gains(
    sums: ClusterSums, model: DistortionModel, theta: Float, inverse: Float, priors: GaussianPriors
) -> Gains:
    """What scores do to the parameters.

    A frame leaves no score in its own directions: the sum over the cells of its exposure is zero
    there, whatever error all stars of the exposure have in common.  The scores of single cells are
    not zero, and must not be held against that sum.  The first exposure, whose frame is the gauge
    or part of it, has one in effect; it is taken for that of another exposure.

    Parameters
    ----------
    sums : ClusterSums
    model : DistortionModel
    theta : ndarray, shape (D,)
    inverse : ndarray, shape (D, P)
        Rows of the inverse of the normal matrix.
    priors : GaussianPriors

    Returns
    -------
    Gains
    """
    groups = sums.groups
    along, n = list(_along_gauge(model, theta, groups)), model.n_distortion
    by_group = [inverse[:, c] @ d for c, d in along]
    if not model.n_frame or groups.exposure.max() < 1:
        return Gains(by_group, by_group, by_group, [])
    by_exposure = [inverse[:, c[c < n]] @ d[c < n] for c, d in along]
    code = np.where(groups.exposure > 0, groups.exposure, groups.exposure.max())
    moves = []
    for (columns, d), e in zip(
        _along_gauge(model, theta, replace(groups, exposure=code)), code, strict=True
    ):
        block = model.frame_slice(int(e))
        own = columns >= block.start
        move = np.zeros((model.n_frame, d.shape[1]))
        move[columns[own] - block.start] = d[own]
        moves.append(move)
    weights = [_weight(sums, model, theta, g) for g in range(len(groups))]
    out, total = list(by_group), np.zeros((model.n_frame, model.n_frame))
    for e in np.unique(groups.exposure):
        members = np.flatnonzero(groups.exposure == e)
        information = np.diag(priors.precision[model.frame_slice(int(code[members[0]]))])
        answer = np.zeros((len(inverse), model.n_frame))
        for g in members:
            information = information + moves[g] @ weights[g] @ moves[g].T
            answer += by_group[g] @ weights[g] @ moves[g].T
        share = answer @ _inverse(information)
        total += information
        for g in members:
            out[g] = by_group[g] - share @ moves[g]
    root = determined(total)
    first = [int(np.argmax(groups.chip == c)) for c in range(len(model.chips))]
    return Gains(by_group, out, by_exposure, [moves[g].T @ root for g in first])


def _along_gauge(
    model: DistortionModel, theta: Float, groups: Groups
) -> list[tuple[NDArray[np.int64], Float]]:
    """Columns, and derivatives (m, 2K) by them of a group's coefficients, its frame turned back."""
    out = []
    jacobians = model.effective_jacobian(theta, groups)
    for (columns, d), exposure in zip(jacobians, groups.exposure, strict=True):
        back = np.linalg.inv(model.frame(theta, int(exposure))[0])
        out.append((columns, np.einsum("akm,ba->mbk", d, back).reshape(len(columns), -1)))
    return out


def _weight(sums: ClusterSums, model: DistortionModel, theta: Float, g: int) -> Float:
    """Information (2K, 2K) of a group, along the axes of the polynomials."""
    uu, uv, vv = sums.equations.weight[g]
    turn = model.frame(theta, int(sums.groups.exposure[g]))[0]
    turned = np.kron(turn, np.eye(model.n_terms))
    return np.asarray(turned.T @ np.block([[uu, uv], [uv, vv]]) @ turned)


def _inverse(matrix: Float) -> Float:
    """Inverse of a matrix of several units, without what it does not hold."""
    scale = np.sqrt(np.diag(matrix))
    scale = np.outer(*[np.where(scale > 0, scale, 1.0)] * 2)
    return np.asarray(np.linalg.pinv(matrix / scale, hermitian=True) / scale)
