"""Normal equations of the highest order by group of stars, which contain those of all lower orders.

The terms of a polynomial are sorted by total order, so that the normal matrix of a lower order is
the first part of that of a higher one.  A fold is a bin of the detector, or a random subset of the
stars.  With the sums of each fold, every order is fitted to all folds, to all but one, or to the
means of the folds, without the data.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer import kernel
from bayesdist.infer.stars.likelihood import Clip
from bayesdist.infer.stars.stars import Stars
from bayesdist.infer.stars.sums import Sums
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.streams import mixed


@dataclass(frozen=True, eq=False)
class FoldStatistics(Sums):
    """Sums over the stars of each fold, about one polynomial."""

    count: Int  # number (F,) of stars, including clipped ones
    weight: Float  # sum (F, 2, K, K) of w phi phi^T of u and of v
    right: Float  # sum (F, 2, K) of w r phi, r the residual

    def joined(self, code: Int, n: int) -> FoldStatistics:
        """Sums of `n` larger folds; `code` (F,) is the larger fold of each."""

        def joined(column: NDArray[Any]) -> NDArray[Any]:
            out = np.zeros((n, *column.shape[1:]), column.dtype)
            np.add.at(out, code, column)
            return out

        return FoldStatistics(joined(self.count), joined(self.weight), joined(self.right))

    def filled(self) -> FoldStatistics:
        """Sums of the folds that have weight."""
        has = self.weight[:, 0, 0, 0] > 0
        return FoldStatistics(self.count[has], self.weight[has], self.right[has])


def bin_sums(stars: Stars, theta: Float, clip: Clip, bins: int) -> FoldStatistics:
    """Sums of equal bins that cover the detector, `bins` on each axis: fold `iy * bins + ix`.

    The stars are of one chip, without frames; residuals are taken about `theta`, and `clip` leaves
    stars out.
    """
    code = cell_index(stars.X, stars.Y, (bins, bins))
    return _sums(stars, code, bins * bins, theta, clip)


def fold_sums(stars: Stars, theta: Float, clip: Clip, folds: int) -> FoldStatistics:
    """Sums of `folds` random subsets of the stars; other arguments as of `bin_sums`.

    The subset of a star follows from the digits of its own numbers, so that it depends neither on
    the order of the rows nor on the chunks into which the data are cut.
    """
    bits = np.zeros(len(stars), np.uint64)
    for column in (stars.X, stars.Y, stars.u, stars.v):
        bits = mixed(bits ^ np.ascontiguousarray(column).view(np.uint64))
    return _sums(stars, (bits % np.uint64(folds)).astype(np.int64), folds, theta, clip)


def _sums(stars: Stars, code: Int, n: int, theta: Float, clip: Clip) -> FoldStatistics:
    count = np.bincount(code, minlength=n)
    order = np.argsort(code, kind="stable")
    present = np.flatnonzero(count)
    starts = np.concatenate([[0], np.cumsum(count[present])])

    def powers(at: Float) -> Float:
        return np.repeat(stars.powers(at), len(present), axis=0)

    moments = kernel.least_squares_moments(
        kernel.pieces_of(starts, kernel.PIECE),
        tuple(column[order] for column in stars.columns),
        powers(theta),
        powers(clip.theta),
        stars.model.order,
        chi2_limit=clip.chi2_limit,
        abs_limit=clip.abs_limit,
    )
    K = stars.model.n_terms
    weight, right = np.zeros((n, 2, K, K)), np.zeros((n, 2, K))
    weight[present] = moments.weight[:, 0::2]
    right[present] = moments.right
    return FoldStatistics(count, weight, right)


def truncated(weight: Float, right: Float, about: Float, n_terms: int) -> Float:
    """Coefficients (..., K), minus `about`, of a fit with only the first `n_terms` terms.

    `weight` (..., K, K) and `right` (..., K) are the normal equations of the residuals about the
    polynomial `about` (..., K).
    """
    low, high = slice(None, n_terms), slice(n_terms, None)
    out = -np.broadcast_to(about, right.shape)
    # the fit lacks the high terms of `about`: their part returns to the residuals
    owed = np.einsum("...kl,...l->...k", weight[..., low, high], out[..., high])
    out[..., low] = np.linalg.solve(weight[..., low, low], (right[..., low] - owed)[..., None])[
        ..., 0
    ]
    return out


def departures(sums: FoldStatistics, about: Float, n_terms: list[int]) -> Float:
    """Coefficients (orders, 2, K) of each order's fit to all folds, minus `about`."""
    weight, right = sums.weight.sum(axis=0), sums.right.sum(axis=0)
    return np.stack([truncated(weight, right, about, k) for k in n_terms])


def held_out_gain(sums: FoldStatistics, about: Float, n_terms: list[int]) -> Float:
    """Log predictive density (F, orders, 2) of every fold by each order's fit to all others.

    It is minus half the difference of the fold's chi-square, of u and of v, from that about the
    coefficients `about` (2, K), and so up to a constant that all orders share.  The coefficients'
    own uncertainty is not added to the errors: where a star's leverage h is small, that would
    change the expectation by terms of the second order in h only.
    """
    weight = sums.weight.sum(axis=0) - sums.weight
    right = sums.right.sum(axis=0) - sums.right
    out = np.empty((len(sums.count), len(n_terms), 2))
    for m, k in enumerate(n_terms):
        d = truncated(weight, right, about, k)
        out[:, m] = np.einsum("lak,lak->la", sums.right, d)
        out[:, m] -= 0.5 * np.einsum("lak,lakm,lam->la", d, sums.weight, d, optimize=True)
    return out
