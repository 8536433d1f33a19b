"""What clusters of stars show of a covariance: their sums, put together."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.robust.cells import Cells
from bayesdist.infer.robust.level import Level
from bayesdist.model import DistortionModel, Groups

__all__ = ["Evidence"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Evidence:
    """Clusters by cells of the detector and by exposures, beside the formal covariance.

    The covariance is that of the first D of P parameters: of all, or of polynomials and drift.

    Parameters
    ----------
    model : DistortionModel
    mean : ndarray, shape (P,)
    formal : ndarray, shape (D, D)
        Inverse of the information at the mean.
    by_priors : ndarray, shape (D, D)
        The part of it that priors contribute; it has nothing to do with stars.
    cells : Cells
        The smallest ones.
    levels : tuple of Level
        These, and larger and larger ones.
    exposures : ndarray, shape (E, D), or None
        By what the errors of each exposure move the parameters, its own deviations among them.
    groups : Groups
        Of chip, exposure and epoch that have stars.
    by_frames : ndarray, shape (D, D), optional
        The part of `by_priors` that comes from the deviations of exposures; none by default.
    whole : ndarray, shape (P, P), optional
        Formal covariance of all parameters, where D is less than P.
    settled : ndarray of int
        Which of the D are means over the frames of the exposures: of their errors exposures say
        nothing here.
    detector : bool
        Whether cells tell what the stars of a place have in common; not where it was fitted.
    known : tuple of ndarray, shape (D, D)
        What is in the variance by the cells of each level beside `formal`, and is counted
        elsewhere; empty for nothing.
    """

    model: DistortionModel
    mean: Float
    formal: Float
    by_priors: Float
    cells: Cells
    levels: tuple[Level, ...]
    exposures: Float | None
    groups: Groups
    by_frames: Float | None = None
    whole: Float | None = None
    settled: Int = field(default_factory=lambda: np.zeros(0, np.int64))
    detector: bool = True
    known: tuple[Float, ...] = ()

    def from_cells(self, k: int = 0) -> Float:
        """Covariance (D, D) by the cells of levels `k` and `k` + 1, and the exposures'.

        Chance may leave combinations of parameters with a variance below zero.
        """
        fine, coarse = self.levels[k], self.levels[k + 1]
        if self.detector:
            out = self.by_priors + 2 * _squares(coarse.influence) - _squares(fine.influence)
            if self.known:
                out -= 2 * self.known[k + 1] - self.known[k]
        else:
            out = self.formal.copy()
        if self.exposures is not None:
            assert coarse.within is not None and fine.within is not None
            more = self._of_exposures - (2 * coarse.within - fine.within)
            if self.by_frames is not None:  # the frames' scatter is among the exposures' errors
                more -= self.by_frames
            more[self.settled] = more[:, self.settled] = 0.0
            out += more
        return np.asarray(out)

    @property
    def _of_exposures(self) -> Float:
        assert self.exposures is not None
        n = len(self.exposures)
        return n / (n - 1) * _squares(self.exposures)

    def _variance(self, rows: Float, k: int) -> tuple[Float, Float]:
        """Variance of a measured variance (n,) and of all entries of a matrix (n,).

        Parameters
        ----------
        rows : ndarray, shape (n, r, D)
            Derivatives of the r quantities whose variances are added, or whose covariance it is.
        k : int
            Level.
        """
        out = np.zeros((2, len(rows)))
        if self.detector:
            near, far = (level.moments(rows) for level in self.levels[k : k + 2])
            raw = self._ratio_to(near[0], rows, k)
            # products of neighbours come to the squares that both have
            out += np.maximum(4 * far[1:] - 3 * near[1:], far[1:]) * raw**2
        if self.exposures is not None:
            own = rows @ self._of_exposures @ np.swapaxes(rows, -1, -2)
            trace, m = np.einsum("nrr->n", own) ** 2, len(self.exposures) - 1
            # an estimate from m exposures has squares of its own noise in its square
            square = (own**2).sum(axis=(1, 2)) - trace / m
            square = np.maximum(square * m**2 / max((m - 1) * (m + 2), 1), trace / rows.shape[1])
            out += np.stack([2 * square, trace + square]) / m
        return out[0], out[1]

    def _ratio_to(self, expected: Float, rows: Float, k: int) -> Float:
        """What the cells alone show (n,), over what is expected of independent stars."""
        fine, coarse = self.levels[k : k + 2]
        found = 2 * self._square(coarse.influence, rows) - self._square(fine.influence, rows)
        return np.maximum(found / expected, 1e-3)

    @staticmethod
    def _square(influence: Float, rows: Float) -> Float:
        """Sum (n,) of the squares of what all clusters do to quantities (n, r, D)."""
        return np.asarray(((rows @ influence.T) ** 2).sum(axis=(1, 2)))


def _squares(influence: Float) -> Float:
    return influence.T @ influence
