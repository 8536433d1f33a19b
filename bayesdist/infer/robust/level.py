"""What each cell of one size does to the parameters, and the covariance that follows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.robust.cells import Cells
from bayesdist.infer.robust.gains import Gains
from bayesdist.infer.robust.leverage import FrameShare, Leverage, leverage_of
from bayesdist.infer.robust.sums import ClusterSums

__all__ = ["Level", "exposure_influence", "level_of"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Level:
    """Cells of one size.

    Parameters
    ----------
    factor : int
        How many times as long and wide as the smallest ones.
    influence : ndarray, shape (cells of all chips, D)
        By what the errors of the stars of a cell, all exposures together, move the parameters.
    within : ndarray, shape (D, D) or None
        Sum of the squares of what the stars of a cell in a single exposure do, their frame aside.
    score : tuple of ndarray, shape (C, 2K)
        Of each group, not corrected for leverage.
    leverage : tuple of Leverage
        Of each chip.
    gain : tuple of ndarray, shape (D, 2K)
        Of each chip: derivative of the parameters by the score, on the mean over its groups.
    """

    factor: int
    influence: Float
    within: Float | None
    score: tuple[Float, ...]
    leverage: tuple[Leverage, ...]
    gain: tuple[Float, ...]

    @property
    def largest_leverage(self) -> float:
        """Largest share of one cell in what is known of any combination of coefficients."""
        return max(float(one.values.max()) for one in self.leverage)

    def moments(self, rows: Float) -> Float:
        """Expectations and variances (3, n), as `Leverage.moments`, of n times r quantities.

        Parameters
        ----------
        rows : ndarray, shape (n, r, D)
            Their derivatives by the parameters.
        """
        parts = zip(self.leverage, self.gain, strict=True)
        return np.asarray(sum(leverage.moments(rows @ gain) for leverage, gain in parts))


def level_of(sums: ClusterSums, cells: Cells, factor: int, gains: Gains, *, within: bool) -> Level:
    """The cells, merged to larger ones.

    Parameters
    ----------
    sums : ClusterSums
    cells : Cells
        Of the sums.
    factor : int
    gains : Gains
    within : bool
        Whether cells of single exposures are asked for.

    Returns
    -------
    Level
    """
    shapes, into = cells.merged(factor)
    counts = [nx * ny for nx, ny in shapes]
    first = np.concatenate([[0], np.cumsum(counts)])
    order = _order_of(sums.score.shape[-1])
    leverage = tuple(
        leverage_of(_merged(weight, code, n), order)
        for weight, code, n in zip(sums.weight, into, counts, strict=True)
    )
    shares = []
    if within:
        shares = [FrameShare.of(*each) for each in zip(leverage, gains.frame, strict=False)]
    D = len(gains.by_group[0])
    influence = np.zeros((first[-1], D))
    squares = np.zeros((D, D)) if within else None
    scores, total = [], np.zeros(len(counts))
    mean = [np.zeros_like(gains.by_group[0]) for _ in counts]
    for g, (chip, gain) in enumerate(zip(sums.groups.chip, gains.by_group, strict=True)):
        score = _merged(sums.score[g], into[chip], counts[chip]).reshape(counts[chip], -1)
        corrected = leverage[chip].corrected(score)
        influence[first[chip] : first[chip + 1]] += corrected @ gain.T
        if squares is not None:
            alone = gains.without_frame[g]
            # one exposure's part of a cell has leverage on the frame and next to none beside
            own = shares[chip].given_back(score) if shares else score
            squares += alone @ (own.T @ own) @ alone.T
        information = float(sums.equations.weight[g, 0, 0, 0])
        mean[chip] += information * gain
        total[chip] += information
        scores.append(score)
    by_chip = tuple(m / t for m, t in zip(mean, total, strict=True))
    return Level(factor, influence, squares, tuple(scores), leverage, by_chip)


def exposure_influence(sums: ClusterSums, gains: Gains) -> Float:
    """By what the errors of each exposure move the parameters, (E, D)."""
    when = np.column_stack([sums.groups.exposure, sums.groups.epoch])
    exposures, code = np.unique(when, axis=0, return_inverse=True)
    out = np.zeros((len(exposures), len(gains.by_group[0])))
    for g, e in enumerate(code.ravel()):
        out[e] += gains.by_exposure[g] @ sums.score[g].sum(axis=0).ravel()
    return out


def _merged(values: Float, code: NDArray[np.int64], n: int) -> Float:
    out = np.zeros((n, *values.shape[1:]))
    np.add.at(out, code, values[: len(code)])
    return out


def _order_of(n_terms: int) -> int:
    """Order of a polynomial with so many terms."""
    return int((np.sqrt(8 * n_terms + 1) - 3) / 2 + 1e-9)
