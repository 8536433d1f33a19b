"""Least-squares fit of a linear transformation from reference stars to detections.

It removes constant and linear offsets from a set of pairs (TRSrvb in WSDC D-T033, section 3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.stars.stars import Sums
from bayesdist.missions.wise.rvb.transform import PARAMETERS, RvbTransform
from bayesdist.utils.arrays import Float

FREE = 5  # number of fitted parameters, the first ones of `PARAMETERS`
_RANK = 1e-12  # smallest ratio of eigenvalues of the normal matrix scaled to unit diagonal


@dataclass(frozen=True, eq=False)
class LinearMoments(Sums):
    """Sums over pairs for the normal equations; those of parts of the data can be added."""

    SAME = ("centre",)

    # (2, 3, 3), for x and y: sum of w p p^T with p = (1, u - centre_u, v - centre_v)
    weight: Float
    right: Float  # (2, 3), sum of w p times the offset of the detection, x - u or y - v
    chi2: float  # sum of w times the squared offsets
    n: int  # number of pairs
    centre: tuple[float, float]


def linear_moments(matches: Matches, centre: tuple[float, float]) -> LinearMoments:
    """Sums over pairs for the fit of a linear transformation.

    Parameters
    ----------
    matches : Matches
        Pairs with errors, and with u and v in pixels of the array.
    centre : tuple of float
        Centre of the transformation, usually that of the array.

    Returns
    -------
    LinearMoments

    Raises
    ------
    InputError
        If the pairs have no errors, or u and v are not in pixels.
    """
    sources = ", ".join(matches.sources)
    if matches.sigma_u is None or matches.sigma_v is None:
        raise InputError("the matches have no errors", where=sources, do="give sigma columns")
    if matches.unit != "pix":
        raise InputError(
            f"u, v are in {matches.unit}, but the detections in pixels",
            where=sources,
            do="convert u, v to pixels of the array",
        )
    design = np.stack([np.ones(len(matches)), matches.u - centre[0], matches.v - centre[1]])
    offsets = (matches.x - matches.u, matches.y - matches.v)
    weight, right, chi2 = np.empty((2, 3, 3)), np.empty((2, 3)), 0.0
    for axis, (offset, sigma) in enumerate(
        zip(offsets, (matches.sigma_u, matches.sigma_v), strict=True)
    ):
        weighted = design / sigma**2
        weight[axis] = weighted @ design.T
        right[axis] = weighted @ offset
        chi2 += float(((offset / sigma) ** 2).sum())
    return LinearMoments(weight, right, chi2, len(matches), centre)


@dataclass(frozen=True, eq=False)
class TransformFit:
    """Fitted linear transformation from reference stars to detections."""

    transform: RvbTransform
    # (6, 6), formal covariance in the order of `PARAMETERS`; zero for the skew.  It excludes the
    # effect of uncorrected distortion, which increases chi2 / dof
    cov: Float
    chi2: float
    dof: int

    @property
    def sigma(self) -> Float:
        """Formal errors of the six parameters."""
        return np.sqrt(np.diag(self.cov))

    @property
    def sentence(self) -> str:
        """Parameters with their errors as a sentence."""
        values = zip(PARAMETERS, self.transform.values, self.sigma, strict=True)
        found = ", ".join(f"{name} {value:.6g} +- {sigma:.2g}" for name, value, sigma in values)
        return f"fitted: {found} (pixels, radians, relative); chi-square {self.chi2:.4g}/{self.dof}"


def fit_transform(moments: LinearMoments) -> TransformFit:
    """Fit the five parameters, without skew, of the map from (u, v) to (x, y) by least squares.

    Use `transformed` with the result to remove constant and linear offsets from the pairs.  Raises
    DegenerateError if the pairs do not determine the parameters, for example if they are on a line.
    """
    now = RvbTransform(centre=moments.centre)
    # indices of the affine coefficients of x and y in `jacobian`: shift, then matrix by rows
    order = np.array([[0, 2, 3], [1, 4, 5]])
    weight, right = np.zeros((6, 6)), np.zeros(6)
    for axis in (0, 1):
        weight[np.ix_(order[axis], order[axis])] = moments.weight[axis]
        right[order[axis]] = moments.right[axis]
    for _ in range(30):
        jacobian = now.jacobian()[:, :FREE]
        normal = jacobian.T @ weight @ jacobian
        _require_rank(normal)
        step = np.linalg.solve(normal, jacobian.T @ (right - weight @ _offset(now)))
        values = now.values
        values[:FREE] += step
        now = replace(now, **dict(zip(PARAMETERS, values.tolist(), strict=True)))
        # converged if the step is far below the errors, or at the level of rounding
        if step @ normal @ step < max(1e-16, 1e-28 * moments.chi2):
            break
    else:
        raise DegenerateError(
            "the linear transformation does not converge",
            where="linear transformation",
            do="check that x, y and u, v are positions on the same array",
        )
    cov = np.zeros((6, 6))
    cov[:FREE, :FREE] = np.linalg.inv(normal)
    offset = _offset(now)
    chi2 = moments.chi2 - 2 * right @ offset + offset @ weight @ offset
    return TransformFit(now, cov, float(chi2), 2 * moments.n - FREE)


def _offset(transform: RvbTransform) -> Float:
    """Shift, and matrix minus identity by rows; small values keep their precision."""
    return np.concatenate([transform.shift, (transform.matrix - np.eye(2)).ravel()])


def _require_rank(normal: Float) -> None:
    scale = np.sqrt(np.diag(normal))
    dead = scale == 0
    values, vectors = np.linalg.eigh(normal / np.outer(*[np.where(dead, 1.0, scale)] * 2))
    if values[0] < _RANK * values[-1]:
        parts = np.abs(vectors[:, 0])
        undetermined = [
            n for n, part in zip(PARAMETERS, parts, strict=False) if part > 0.1 * parts.max()
        ]
        raise DegenerateError(
            f"the pairs do not determine {', '.join(undetermined)}",
            where="linear transformation",
            do="give pairs that cover the whole array",
        )
