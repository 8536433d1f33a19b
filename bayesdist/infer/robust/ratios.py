"""Measured errors beside formal ones, and how well they are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

__all__ = ["CellSize", "PositionSigmas", "Ratio"]

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Ratio:
    """A measured variance over the formal one.

    Parameters
    ----------
    value : float
    error : float
        Standard deviation of the value.
    dof : float
        Degrees of freedom of a chi-square variable with as large a relative error.
    """

    value: float
    error: float
    dof: float

    @property
    def p_value(self) -> float:
        """Probability of as large a ratio where errors are independent."""
        return float(stats.chi2.sf(self.dof * self.value, self.dof))


@dataclass(frozen=True, eq=False)
class PositionSigmas:
    """Errors of the model's positions.

    Parameters
    ----------
    sigma : ndarray, shape (N, 2)
        Measured from the clusters, in the unit of u, v; not raised to the formal one where chance
        makes it smaller.
    formal : ndarray, shape (N, 2)
        Those of independent stars.
    dof : ndarray, shape (N, 2)
        Degrees of freedom with which `sigma` is known.
    """

    sigma: Float
    formal: Float
    dof: Float

    @property
    def ratio(self) -> Float:
        """Measured over formal error (N, 2)."""
        return self.sigma / self.formal

    def half_width(self, probability: float) -> Float:
        """Half the width (N, 2) of the central interval, by Student's t."""
        return np.asarray(self.sigma * stats.t.ppf(0.5 + probability / 2, self.dof))


@dataclass(frozen=True)
class CellSize:
    """What cells of one size say of the variance.

    Parameters
    ----------
    pixels : float
        Longest side of a cell.
    alone : float
        Ratio to the formal variance with these cells taken for independent.
    ratio : Ratio
        With what crosses their borders: from these cells and those half as long and wide.
    """

    pixels: float
    alone: float
    ratio: Ratio
