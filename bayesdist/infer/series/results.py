"""What is read off a posterior: differences with their covariance, and predictions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi_squared

__all__ = ["Change", "Prediction"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Change:
    """How a set of coefficients differs, with covariance.

    Parameters
    ----------
    value : ndarray, shape (k,)
    cov : ndarray, shape (k, k)
    """

    value: Float
    cov: Float

    @classmethod
    def of(cls, draws: Float) -> Change:
        """From draws (n, k) of a difference."""
        return cls(draws.mean(axis=0), np.atleast_2d(np.cov(draws, rowvar=False)))

    @property
    def sigma(self) -> Float:
        """Standard deviations, shape (k,)."""
        return np.sqrt(np.diag(self.cov))

    @property
    def significance(self) -> Float:
        """Value over sigma of each, shape (k,)."""
        return self.value / self.sigma

    @property
    def chi2(self) -> float:
        """Of all together against no difference, with k degrees of freedom."""
        unit = self.sigma
        scaled = self.cov / unit[:, None] / unit
        return float(self.significance @ np.linalg.solve(scaled, self.significance))

    @property
    def p_value(self) -> float:
        """Probability of so large a chi-square where nothing differs."""
        return float(chi_squared.sf(self.chi2, len(self.value)))


@dataclass(frozen=True, eq=False)
class Prediction:
    """The coefficients at M epochs.

    Parameters
    ----------
    epoch : ndarray, shape (M,)
    mean : ndarray, shape (M, k)
    cov : ndarray, shape (M, k, k)
        Of the course.
    cov_new : ndarray, shape (M, k, k)
        Of an exposure that is no outlier and has no formal error: the course's and the intrinsic.
    """

    epoch: Float
    mean: Float
    cov: Float
    cov_new: Float

    @property
    def sigma(self) -> Float:
        """Of the course, shape (M, k)."""
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))

    @property
    def sigma_new(self) -> Float:
        """Of a new exposure, shape (M, k)."""
        return np.sqrt(np.diagonal(self.cov_new, axis1=1, axis2=2))
