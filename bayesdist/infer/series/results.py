"""Results from a posterior: differences with their covariance, and predictions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi_squared

__all__ = ["Change", "Prediction"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Change:
    """Difference of a set of coefficients, with covariance.

    Parameters
    ----------
    value : ndarray, shape (k,)
    cov : ndarray, shape (k, k)
    """

    value: Float
    cov: Float

    @classmethod
    def of(cls, draws: Float) -> Change:
        """Change from draws (n, k) of a difference."""
        return cls(draws.mean(axis=0), np.atleast_2d(np.cov(draws, rowvar=False)))

    @property
    def sigma(self) -> Float:
        """Standard deviations (k,)."""
        return np.sqrt(np.diag(self.cov))

    @property
    def free(self) -> NDArray[np.bool_]:
        """Boolean mask (k,) of those that can differ: the slope of a step cannot."""
        return self.sigma > 0

    @property
    def significance(self) -> Float:
        """Value over sigma (k,) of each; 0 for those that cannot differ."""
        return np.where(self.free, self.value / np.where(self.free, self.sigma, 1.0), 0.0)

    @property
    def chi2(self) -> float:
        """Chi-square of all that can differ together, against no difference."""
        some = np.flatnonzero(self.free)
        unit = self.sigma[some]
        scaled = self.cov[np.ix_(some, some)] / np.outer(unit, unit)
        return float(self.significance[some] @ np.linalg.solve(scaled, self.significance[some]))

    @property
    def p_value(self) -> float:
        """Probability of a larger chi-square where nothing differs.

        Of a Gaussian: with few exposures the posterior has heavier tails, and this is too small.
        """
        n = int(self.free.sum())
        return float(chi_squared.sf(self.chi2, n)) if n else 1.0


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
        """Standard deviations (M, k) of the course."""
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))

    @property
    def sigma_new(self) -> Float:
        """Standard deviations (M, k) of a new exposure."""
        return np.sqrt(np.diagonal(self.cov_new, axis1=1, axis2=2))
