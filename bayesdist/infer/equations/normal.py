"""Normal equations as sums over groups of stars, accumulated in chunks.

Within a group the model is a single polynomial, so the data enter only through the moments of the
basis functions.  Partial sums over chunks of the data can be added.  Since positions are linear in
the effective coefficients, the equations can be re-expanded about other coefficients exactly and
without the data.  Gauss-Newton over the exposure frames therefore needs no further pass.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.infer import kernel
from bayesdist.infer.equations.arrow import Arrow
from bayesdist.infer.kernel import Constants
from bayesdist.infer.stars.likelihood import Clip
from bayesdist.infer.stars.stars import Stars
from bayesdist.infer.stars.sums import Sums
from bayesdist.model import DistortionModel, Groups
from bayesdist.utils.arrays import Float


@dataclass(frozen=True, eq=False)
class NormalEquations(Sums):
    """Sums over G groups of stars that form the normal equations for K polynomial terms.

    Sums over different stars of a group can be added if they have the same `about`.
    """

    weight: Float  # sum (G, 3, K, K) of w phi phi^T for the axis pairs uu, uv, vv
    right: Float  # sum (G, 2, K) of phi (W r), with r the residual at `about`
    about: Float  # effective coefficients (G, 2, K) at which r is computed
    chi2: float  # sum of r^T W r
    cross: Float  # mixed second derivatives (G, h, 2, K) with h additional parameters
    scalars: Float  # additional sums over the stars, documented by the kernel that computes them
    groups: Groups

    BY_GROUP = ("weight", "right", "cross")
    OF_GROUP = ("about",)

    def moved(self, about: Float) -> NormalEquations:
        """Re-expand about other effective coefficients (G, 2, K); exact, and without the data."""
        step = about - self.about
        pull = self._apply(step)
        chi2 = self.chi2 - 2 * float((self.right * step).sum()) + float((pull * step).sum())
        return replace(self, right=self.right - pull, about=about, chi2=chi2)

    def _apply(self, E: Float) -> Float:
        uu, uv, vv = self.weight[:, 0], self.weight[:, 1], self.weight[:, 2]
        u = np.einsum("gkl,gl->gk", uu, E[:, 0]) + np.einsum("gkl,gl->gk", uv, E[:, 1])
        v = np.einsum("gkl,gl->gk", uv, E[:, 0]) + np.einsum("gkl,gl->gk", vv, E[:, 1])
        return np.stack([u, v], axis=1)

    def assemble(self, model: DistortionModel, theta: Float) -> tuple[Arrow, Float]:
        """Normal matrix and right-hand side (n_params,) for the model's parameters.

        The model is linearised at `theta` (n_params,); its effective coefficients must be `about`.
        The h additional parameters form the tail of the matrix, with the mixed derivatives `cross`
        and zeros elsewhere.
        """
        G, q, h = model.n_global, model.n_frame, self.cross.shape[1]
        n_blocks = len(model.local_blocks)
        border = np.zeros((G + h, G + h))
        edge = np.zeros((n_blocks, G + h, q))
        blocks = np.zeros((n_blocks, q, q))
        right = np.zeros(model.n_params)
        tail = slice(G, G + h)
        for rows, columns, d in model.jacobian_blocks(theta, self.groups):
            du, dv = d[:, 0], d[:, 1]
            uu, uv, vv = np.moveaxis(self.weight[rows], 1, 0)
            H = du.mT @ (uu @ du + uv @ dv) + dv.mT @ (uv @ du + vv @ dv)
            np.add.at(right, columns, np.einsum("nakm,nak->nm", d, self.right[rows]))
            X = np.einsum("nhak,nakm->nhm", self.cross[rows], d)
            n, m = int((columns[0] < G).sum()), columns.shape[1]
            glob = columns[0, :n]
            border[np.ix_(glob, glob)] += H[:, :n, :n].sum(axis=0)
            across = X[:, :, :n].sum(axis=0)
            border[tail, glob] += across
            border[glob, tail] += across.T
            if n < m:
                # groups are sorted by exposure; an exposure may have several of them (chips, dates)
                e, first = divmod(columns[:, n] - G, q)
                local = columns[0, n:] - columns[0, n] + first[0]
                at, starts = np.unique(e, return_index=True)
                by_local = np.concatenate([H[:, :, n:], X[:, :, n:]], axis=1)
                of_exposure = np.add.reduceat(by_local, starts)
                edge[np.ix_(at, glob, local)] += of_exposure[:, :n]
                edge[np.ix_(at, np.r_[tail], local)] += of_exposure[:, m:]
                blocks[np.ix_(at, local, local)] += of_exposure[:, n:m]
        return Arrow(border, edge, blocks, n_tail=h), right


def least_squares(
    stars: Stars,
    about: Float | None,
    clip: Clip | None = None,
    corner: float = 1.0,
    power: int = 1,
) -> NormalEquations:
    """Accumulate the normal equations of weighted least squares in one pass over the stars.

    Residuals are computed at the parameters `about` (n_params,); None means zero, so that they are
    the data.  `clip` has the rejection limits; None keeps all stars.  See
    `kernel.least_squares_moments` for `corner`, `power` and the `scalars` of the result.
    """
    moments = kernel.least_squares_moments(
        stars.pieces,
        stars.columns,
        stars.powers(about),
        stars.powers(None if clip is None else clip.theta),
        stars.model.order,
        chi2_limit=np.inf if clip is None else clip.chi2_limit,
        abs_limit=np.inf if clip is None else clip.abs_limit,
        corner=corner,
        power=power,
    )
    if about is None:
        E = np.zeros((len(stars.groups), 2, stars.model.n_terms))
    else:
        E = stars.model.effective(about, stars.groups)
    chi2, no_cross = float(moments.scalars[6]), moments.cross[:, :0]
    return NormalEquations(
        moments.weight, moments.right, E, chi2, no_cross, moments.scalars, stars.groups
    )


def mixture(stars: Stars, theta: Float, constants: Constants, em: bool = False) -> NormalEquations:
    """Gradient and Hessian of the mixture log-likelihood at `theta`, in one pass over the stars.

    `right` of the result is the gradient with respect to the effective coefficients, and `weight`
    minus the Hessian.  See `kernel.mixture_moments` for `em` and `scalars`.
    """
    powers, order = stars.powers(theta), stars.model.order
    if circle := stars.circle(constants):
        moments = kernel.truncated_moments(
            stars.pieces, stars.columns, circle, powers, order, constants, em=em
        )
    else:
        moments = kernel.mixture_moments(
            stars.pieces, stars.columns, powers, order, constants, em=em
        )
    E = stars.model.effective(theta, stars.groups)
    return NormalEquations(
        moments.weight, moments.right, E, 0.0, moments.cross, moments.scalars, stars.groups
    )
