"""Variance of the stars' scores over the detector, relative to the likelihood's prediction."""

from __future__ import annotations

import numpy as np

from bayesdist.diagnose.clusters import sums_over
from bayesdist.diagnose.correlated.information import Information
from bayesdist.infer.equations.scaled import scaled_inverse
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Float, Int

STARS_PER_BLOCK = 60
MAX_BLOCKS = 8  # along each side of a chip
MIN_RATIO, MAX_RATIO = 0.25, 100.0


def score_excess(information: Information) -> Float:
    """Ratio (chips, C, 2) of the variance of the scores to their curvature, by chip, cell and axis.

    It is 1 for a correct likelihood.  Ratios of blocks of the detector are shrunk to their mean
    according to their errors and their scatter (a normal model of their logarithms, by moments:
    DerSimonian and Laird 1986, Controlled Clinical Trials 7, 177).
    """
    side, n_chips = information.sums.side, len(information.model.chips)
    stars = information.sums.position[:, :, 0].sum(axis=1)
    blocks = np.clip(np.sqrt(stars / STARS_PER_BLOCK).astype(int), 1, MAX_BLOCKS)
    # squared scores and curvatures along both axes, and the number of stars
    sums = np.zeros((n_chips, side * side, 5))
    for cells in information.groups():
        free = 1 - information.leverage(cells)
        squares, curvature = (
            np.einsum("caa->ca", matrix) for matrix in (cells.squares, cells.curvature)
        )
        values = np.column_stack([squares / free, curvature, cells.count])
        sums[cells.chip] += sums_over(
            cell_index(cells.X, cells.Y, (side, side)), values, side * side
        )
    out = np.ones((n_chips, side * side, 2))
    index = np.arange(side)
    for chip in range(n_chips):
        b = int(blocks[chip])
        block = ((index[:, None] * b // side) * b + index * b // side).ravel()
        for a in (0, 1):
            out[chip, :, a] = block_ratios(block, sums[chip][:, [a, 2 + a, 4]], b * b)
    return out


def block_ratios(block: Int, values: Float, n: int) -> Float:
    """Ratios (N,) of the sums over n blocks of squares and curvatures, shrunk to their mean.

    `block` (N,) is the block of each row of `values` (N, 3): square, curvature, number.
    """
    top, bottom, number = sums_over(block, values, n).T
    mean = top.sum() / bottom.sum()
    good = (number >= STARS_PER_BLOCK / 6) & (bottom > 0) & (top > 0)
    out = np.full(n, mean)
    if good.sum() > 1:
        ratio = np.log(top[good] / bottom[good] / mean)
        # the square of a normal variable has variance 2; mixtures have a larger one
        variance = 2.5 / number[good]
        w = 1 / variance
        q = (w * (ratio - np.average(ratio, weights=w)) ** 2).sum()
        scatter = max(0.0, (q - (len(w) - 1)) / (w.sum() - (w**2).sum() / w.sum()))
        out[good] = mean * np.exp(ratio * scatter / (scatter + variance))
    return np.asarray(np.clip(out, MIN_RATIO, MAX_RATIO)[block])


def not_narrower(noise: Float, formal: Float) -> tuple[Float, float]:
    """Covariance from the stars' scatter, at least as large as the formal one, and their ratio.

    Both are (D, D), with zeros for fixed parameters.  The formal covariance is the lower limit
    because residuals cannot distinguish quoted errors that are too large from truncated matches.
    """
    # a small part of the formal covariance, so that no direction has zero variance
    noise = 0.99 * noise + 0.01 * formal
    free = np.flatnonzero(np.diag(formal) > 0)
    inner = np.ix_(free, free)
    ratio = float(np.sum(scaled_inverse(formal[inner]) * noise[inner])) / len(free)
    return noise * max(1.0, 1 / ratio), ratio
