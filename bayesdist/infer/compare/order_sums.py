"""Normal equations of the highest order for groups of stars; they include all lower orders.

The terms of a polynomial are sorted by total order, so that the normal matrix of a lower order is
the leading block of that of a higher order.  A fold is a bin of the detector or a random subset of
the stars.  From the sums of each fold, every order can be fitted to all folds, to all but one, or
to the means of the folds, without another pass over the data.
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
    """Sums over the stars of each of F folds, for residuals from a given polynomial."""

    count: Int  # number (F,) of stars, including clipped stars
    weight: Float  # sum (F, 2, K, K) of w phi phi^T for u and v
    right: Float  # sum (F, 2, K) of w r phi, with r the residual

    def joined(self, code: Int, n: int) -> FoldStatistics:
        """Merge the folds to `n` larger folds; `code` (F,) is the new fold of each."""

        def joined(column: NDArray[Any]) -> NDArray[Any]:
            out = np.zeros((n, *column.shape[1:]), column.dtype)
            np.add.at(out, code, column)
            return out

        return FoldStatistics(joined(self.count), joined(self.weight), joined(self.right))

    def filled(self) -> FoldStatistics:
        """Drop the folds without weight."""
        has = self.weight[:, 0, 0, 0] > 0
        return FoldStatistics(self.count[has], self.weight[has], self.right[has])


def bin_sums(stars: Stars, theta: Float, clip: Clip, bins: int) -> FoldStatistics:
    """Sums for `bins` x `bins` equal bins that cover the detector; fold number iy * bins + ix.

    The model must have one chip and no frames.  Residuals are computed at `theta`, and `clip` has
    the rejection limits.
    """
    code = cell_index(stars.X, stars.Y, (bins, bins))
    return _sums(stars, code, bins * bins, theta, clip)


def fold_sums(stars: Stars, theta: Float, clip: Clip, folds: int) -> FoldStatistics:
    """Sums for `folds` random subsets of the stars; see `bin_sums` for the other arguments.

    The subset of a star is a hash of its coordinates, so that it depends neither on the order of
    the rows nor on the division of the data into chunks.
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
    """Fit only the first `n_terms` terms; return the coefficients (..., K) minus `about`.

    `weight` (..., K, K) and `right` (..., K) are the normal equations for residuals from the
    polynomial `about` (..., K).
    """
    low, high = slice(None, n_terms), slice(n_terms, None)
    out = -np.broadcast_to(about, right.shape)
    # the fit lacks the high-order terms of `about`, so add their contribution to the residuals
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
    """Log predictive density (F, orders, 2) of each fold for each order, fitted to all other folds.

    It is minus half the chi-square of the fold in u and v, relative to that of the coefficients
    `about` (2, K), and thus up to a constant common to all orders.  The uncertainty of the
    coefficients is not added to the errors.  For a small leverage h of the stars, this would change
    the expectation only to second order in h.
    """
    weight = sums.weight.sum(axis=0) - sums.weight
    right = sums.right.sum(axis=0) - sums.right
    out = np.empty((len(sums.count), len(n_terms), 2))
    for m, k in enumerate(n_terms):
        d = truncated(weight, right, about, k)
        out[:, m] = np.einsum("lak,lak->la", sums.right, d)
        out[:, m] -= 0.5 * np.einsum("lak,lakm,lam->la", d, sums.weight, d, optimize=True)
    return out
