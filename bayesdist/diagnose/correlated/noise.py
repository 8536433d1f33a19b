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

    Where the likelihood is right the two agree.  Ratios of blocks of the detector are shrunk to
    their mean as their own errors and their scatter about it require (a normal model of their
    logarithms, by moments: DerSimonian and Laird 1986, Controlled Clinical Trials 7, 177).
    """
    side, n_chips = information.sums.side, len(information.model.chips)
    stars = information.sums.position[:, :, 0].sum(axis=1)
    blocks = np.clip(np.sqrt(stars / STARS_PER_BLOCK).astype(int), 1, MAX_BLOCKS)
    # squared scores and curvatures along both axes, and the number of stars
    sums = np.zeros((n_chips, side * side, 5))
    for cells in information.groups():
        free = 1 - information.leverage(cells)
        squares, curvature = (np.einsum("caa->ca", one) for one in (cells.squares, cells.curvature))
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

    `block` (N,) is that of each of the values (N, 3): squares, curvatures, numbers.
    """
    top, bottom, number = sums_over(block, values, n).T
    mean = top.sum() / bottom.sum()
    good = (number >= STARS_PER_BLOCK / 6) & (bottom > 0) & (top > 0)
    out = np.full(n, mean)
    if good.sum() > 1:
        ratio = np.log(top[good] / bottom[good] / mean)
        own = 2.5 / number[good]  # a normal star's square has variance 2; mixtures have some more
        w = 1 / own
        q = (w * (ratio - np.average(ratio, weights=w)) ** 2).sum()
        scatter = max(0.0, (q - (len(w) - 1)) / (w.sum() - (w**2).sum() / w.sum()))
        out[good] = mean * np.exp(ratio * scatter / (scatter + own))
    return np.asarray(np.clip(out, MIN_RATIO, MAX_RATIO)[block])


def not_narrower(noise: Float, formal: Float) -> tuple[Float, float]:
    """Covariance by the stars' scatter, on the whole not below the formal one, and their ratio.

    Both are (D, D), and zero for parameters that are fixed.
    Quoted errors that are too large are the user's statement: residuals cannot distinguish them
    from matches that were cut.
    """
    # a small part of the formal one, so that no direction is without variance
    noise = 0.99 * noise + 0.01 * formal
    free = np.flatnonzero(np.diag(formal) > 0)
    inner = np.ix_(free, free)
    ratio = float(np.sum(scaled_inverse(formal[inner]) * noise[inner])) / len(free)
    return noise * max(1.0, 1 / ratio), ratio
