"""Cells as clusters: what fitting takes from their scores, and how well they show a variance.

The residuals of a cell are smaller than its errors, as the cell has drawn the fit towards itself.
In coordinates in which the information of all cells adds up to the unit matrix, and that of one is
h, the score of independent errors has the covariance h - h^2 after the fit; (1 - h)^(-1/2) gives it
its h back, so that the covariance is unbiased where errors are independent (Bell and McCaffrey
2002, who work with residuals; a whole cell is known by its h and its score alone).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer import kernel

__all__ = ["FrameShare", "Leverage", "leverage_of"]

Float = NDArray[np.float64]

MOST = 0.99  # of the leverage: a cell that alone determines something has no residual there


@dataclass(frozen=True, eq=False)
class Leverage:
    """Information of the cells of one chip about the coefficients (2 K) of its polynomials.

    Parameters
    ----------
    information : ndarray, shape (C, 2K, 2K)
    root : ndarray, shape (2K, 2K)
        Lower Cholesky factor of the sum.
    values : ndarray, shape (C, 2K)
        Of a cell's h, in coordinates that make the sum the unit matrix.
    vectors : ndarray, shape (C, 2K, 2K)
    """

    information: Float
    root: Float
    values: Float
    vectors: Float

    def corrected(self, score: Float) -> Float:
        """Scores (..., C, 2K) as they were before the fit took its part."""
        flat = score.reshape(-1, score.shape[-1])
        white = np.linalg.solve(self.root, flat.T).T.reshape(score.shape)
        turned = np.einsum("...ck,ckl->...cl", white, self.vectors)
        turned = turned / np.sqrt(1 - self.values)
        return np.einsum("...cl,ckl,jk->...cj", turned, self.vectors, self.root, optimize=True)

    def moments(self, weights: Float) -> Float:
        """What the squares of scores tell of variances, where errors are independent and normal.

        Parameters
        ----------
        weights : ndarray, shape (n, r, 2K)
            Derivatives of r quantities by the total score; z is what a cell's corrected score
            adds to them.

        Returns
        -------
        ndarray, shape (3, n)
            Expectation and variance of the sum over the cells of z^T z; variance of the matrix that
            is the sum of z z^T, its entries added up.
        """
        turned = (weights @ self.root)[:, None] @ self.vectors
        own = (turned * self.values[:, None]) @ np.swapaxes(turned, -1, -2)
        # what the common fit leaves of one cell in the scores of the others
        pull = (self.values / np.sqrt(1 - self.values))[:, None]
        f = (turned * pull) @ np.swapaxes(self.vectors, -1, -2)
        flat = f.reshape(len(f), -1, f.shape[-1])
        shared = ((np.swapaxes(flat, -1, -2) @ flat) ** 2).sum(axis=(1, 2))
        shared -= ((f @ np.swapaxes(f, -1, -2)) ** 2).sum(axis=(1, 2, 3))
        trace = np.einsum("ncrr->nc", own)
        square = (own**2).sum(axis=(1, 2, 3)) + shared
        return np.stack([trace.sum(axis=1), 2 * square, (trace**2).sum(axis=1) + square])


def leverage_of(weight: Float, order: int) -> Leverage:
    """Leverage of the cells of a chip.

    Parameters
    ----------
    weight : ndarray, shape (C, 3, M)
        As in `ClusterSums`.
    order : int

    Returns
    -------
    Leverage
    """
    uu, uv, vv = np.moveaxis(kernel.products_of(weight, order), 1, 0)
    information = np.block([[uu, uv], [uv, vv]])
    root = np.linalg.cholesky(information.sum(axis=0))
    white = np.linalg.solve(root, np.swapaxes(np.linalg.solve(root, information), -1, -2))
    values, vectors = np.linalg.eigh((white + np.swapaxes(white, -1, -2)) / 2)
    # the curvature of few doubtful stars may be negative
    return Leverage(information, root, np.clip(values, 0.0, MOST), vectors)


@dataclass(frozen=True, eq=False)
class FrameShare:
    """What the frames of exposures take of the scores of cells, alike in all exposures.

    With W the information of a cell and F the root of what frames take, the score s after the fit
    has the covariance W - W F F^T W; with h = F^T W F

        s + W F [(1 - h)^(-1/2) - 1] h^-1 F^T s

    has W again.

    Parameters
    ----------
    frame : ndarray, shape (2K, q)
        F.
    back : ndarray, shape (C, 2K, q)
        What stands before F^T s.
    """

    frame: Float
    back: Float

    @classmethod
    def of(cls, leverage: Leverage, frame: Float) -> FrameShare:
        """Of the cells of a chip in all exposures, of which each one has its share.

        Parameters
        ----------
        leverage : Leverage
        frame : ndarray, shape (2K, q)
        """
        by_frame = leverage.information @ frame
        values, vectors = np.linalg.eigh(frame.T @ by_frame)
        values = np.clip(values, 1e-12, MOST)
        factor = ((1 - values) ** -0.5 - 1) / values
        middle = (vectors * factor[:, None]) @ np.swapaxes(vectors, -1, -2)
        return cls(frame, by_frame @ middle)

    def given_back(self, score: Float) -> Float:
        """Scores (..., C, 2K) of one exposure as they were before its frame took its part."""
        return np.asarray(score + np.einsum("ckq,...cq->...ck", self.back, score @ self.frame))
