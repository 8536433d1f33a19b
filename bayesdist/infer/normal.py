"""Normal equations as sums over groups of stars: streaming, mergeable, movable without the data.

Within a group the model is one polynomial, so the data speak only through the moments of the basis
functions.  Partial sums over any pieces of the data add.  Because positions are linear in the
effective coefficients, the equations can be moved to other coefficients exactly, which is how
Gauss-Newton over the exposure frames runs without another pass.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.arrow import Arrow
from bayesdist.infer.stars import Stars
from bayesdist.model import DistortionModel, Groups

__all__ = ["NormalEquations", "accumulate"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Moments of weighted residuals about given effective coefficients.

    Parameters
    ----------
    weight : ndarray, shape (G, 3, K, K)
        sum of w phi phi^T for the axis pairs uu, uv, vv.
    right : ndarray, shape (G, 2, K)
        sum of phi (W r), r the residual at `about`.
    about : ndarray, shape (G, 2, K)
        Effective coefficients at which r is taken.
    chi2 : float
        sum of r^T W r.
    n_rows : int
        Rows with weight.
    cross : ndarray, shape (G, h, 2, K)
        Mixed second derivatives with h further parameters; h = 0 in least squares.
    groups : Groups
    """

    weight: Float
    right: Float
    about: Float
    chi2: float
    n_rows: int
    cross: Float
    groups: Groups

    def __add__(self, other: NormalEquations) -> NormalEquations:
        """Sum over both pieces of data; the pieces share their groups and `about`."""
        if not (np.array_equal(self.about, other.about) and self.groups.same(other.groups)):
            raise ValueError("normal equations of other groups or coefficients do not add")
        return NormalEquations(
            self.weight + other.weight,
            self.right + other.right,
            self.about,
            self.chi2 + other.chi2,
            self.n_rows + other.n_rows,
            self.cross + other.cross,
            self.groups,
        )

    def moved(self, about: Float) -> NormalEquations:
        """The same equations about other effective coefficients: exact, without the data."""
        step = about - self.about
        pull = self._apply(step)
        chi2 = self.chi2 - 2 * float((self.right * step).sum()) + float((pull * step).sum())
        return replace(self, right=self.right - pull, about=about, chi2=chi2)

    def _apply(self, E: Float) -> Float:
        uu, uv, vv = self.weight[:, 0], self.weight[:, 1], self.weight[:, 2]
        u = np.einsum("gkl,gl->gk", uu, E[:, 0]) + np.einsum("gkl,gl->gk", uv, E[:, 1])
        v = np.einsum("gkl,gl->gk", uv, E[:, 0]) + np.einsum("gkl,gl->gk", vv, E[:, 1])
        return np.stack([u, v], axis=1)

    def assemble(self, model: DistortionModel, theta: Float, groups: Groups) -> tuple[Arrow, Float]:
        """Normal matrix and right-hand side in the model's parameters.

        Parameters
        ----------
        model : DistortionModel
        theta : ndarray, shape (n_params,)
            Where the frames are linearised; `about` are its effective coefficients.
        groups : Groups

        Returns
        -------
        matrix : Arrow
            With the h further parameters as zero rows of its tail, but for `cross`.
        right : ndarray, shape (n_params,)
        """
        G, q, h = model.n_global, model.n_frame, self.cross.shape[1]
        n_blocks = len(model.local_blocks)
        border = np.zeros((G + h, G + h))
        edge = np.zeros((n_blocks, G + h, q))
        blocks = np.zeros((n_blocks, q, q))
        right = np.zeros(model.n_params)
        tail = slice(G, G + h)
        for g, (columns, d) in enumerate(model.effective_jacobian(theta, groups)):
            uu, uv, vv = self.weight[g]
            wd_u = uu @ d[0] + uv @ d[1]
            wd_v = uv @ d[0] + vv @ d[1]
            H = d[0].T @ wd_u + d[1].T @ wd_v
            right[columns] += d[0].T @ self.right[g, 0] + d[1].T @ self.right[g, 1]
            X = np.einsum("hak,akm->hm", self.cross[g], d)
            n = int((columns < G).sum())
            glob = columns[:n]
            border[np.ix_(glob, glob)] += H[:n, :n]
            border[tail, glob] += X[:, :n]
            border[glob, tail] += X[:, :n].T
            if n < len(columns):
                e = (columns[n] - G) // q
                edge[e, glob] += H[:n, n:]
                edge[e, tail] += X[:, n:]
                blocks[e] += H[n:, n:]
        return Arrow(border, edge, blocks, n_tail=h), right


def accumulate(
    stars: Stars,
    about: Float,
    weights: Float,
    gradient: Float | None = None,
    cross: Float | None = None,
) -> NormalEquations:
    """One pass over the stars.

    Parameters
    ----------
    stars : Stars
    about : ndarray, shape (G, 2, K)
        Effective coefficients.
    weights : ndarray, shape (N, 2) or (N, 3)
        Weights of u and v; with three columns uu, uv, vv.
    gradient : ndarray, shape (N, 2), optional
        W r of each star, where it is not the weight times the residual at `about`.
    cross : ndarray, shape (N, h, 2), optional

    Returns
    -------
    NormalEquations
    """
    G, K = len(stars.groups), stars.model.n_terms
    h = 0 if cross is None else cross.shape[1]
    weight, right = np.zeros((G, 3, K, K)), np.zeros((G, 2, K))
    mixed, chi2 = np.zeros((G, h, 2, K)), 0.0
    full = weights.shape[1] == 3
    for g, rows, phi in stars.chunks():
        w = weights[rows]
        wu, wv = w[:, 0], w[:, -1]
        if gradient is None:
            ru = stars.u[rows] - phi @ about[g, 0]
            rv = stars.v[rows] - phi @ about[g, 1]
            wr = np.stack([wu * ru, wv * rv], axis=1)
            chi2 += float(wr[:, 0] @ ru + wr[:, 1] @ rv)
        else:
            wr = gradient[rows]
        right[g] += wr.T @ phi
        weight[g, 0] += phi.T @ (wu[:, None] * phi)
        if full:
            weight[g, 1] += phi.T @ (w[:, 1, None] * phi)
        weight[g, 2] += phi.T @ (wv[:, None] * phi)
        if cross is not None:
            mixed[g] += (cross[rows].reshape(len(phi), 2 * h).T @ phi).reshape(h, 2, K)
    return NormalEquations(
        weight, right, about.copy(), chi2, int((weights[:, 0] > 0).sum()), mixed, stars.groups
    )
