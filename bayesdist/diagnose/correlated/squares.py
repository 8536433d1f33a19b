"""Covariance of parameters from the scatter of the stars, as far as the data require it.

The sandwich A^-1 (sum of g g^T) A^-1 is valid for any variances of single stars, but its elements
scatter like sums of squares.  Squared scores divided by (1 - l)^2, with l the leverage of a star
(HC3 of MacKinnon and White 1985, Journal of Econometrics 29, 305), remain valid if stars of high
leverage have larger errors than others, and are 1 / (1 - l) times too large if all stars are alike.
In that case the likelihood's covariance, multiplied by one factor for all stars, is exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bayesdist.utils.arrays import Float

# A star that alone determines a parameter has no residual: its squared score is uninformative.
MIN_FREE = 0.1


@dataclass(frozen=True, eq=False)
class SquaredScores:
    """Information from the scores of the stars, and that expected from the likelihood.

    X : Y below is the sum over stars of trace(A^-1 X_i A^-1 Y_i), where X_i and Y_i are a star's
    contributions to two sums and A is the information of the parameters.
    """

    covariance: Float  # (D, D) A^-1 of the parameters, from likelihood and priors
    expected: Float  # (D, D) information of the likelihood: expectation of the sum of squares
    prior: Float  # (D, D) information of the priors
    # (D, D) from scores divided by sqrt(1 - l) (HC2): unbiased if all stars are alike
    unbiased: Float
    jackknife: Float  # (D, D) from scores divided by 1 - l (HC3)
    # unbiased : unbiased, unbiased : expected, and expected : expected
    products: tuple[float, float, float]

    @cached_property
    def scale(self) -> float:
        """Mean ratio of the squares to their expectation."""
        return float(np.sum(self.covariance * self.unbiased)) / float(
            np.sum(self.covariance * self.expected)
        )

    @cached_property
    def weight(self) -> float:
        """Weight of the sandwich: 0 if the variances of the stars show no differences.

        Let d be the squared distance of the unbiased sum from `scale` times the expected one, and b
        the part of d due to the scatter of single squares.  Then 1 - b / d is the weight of linear
        shrinkage with the smallest expected squared error (Ledoit and Wolf 2004, Journal of
        Multivariate Analysis 88, 365; James and Stein's estimator as an empirical Bayes estimate:
        Efron and Morris 1973, Journal of the American Statistical Association 68, 117).  It is
        doubled, because errors that are too small are worse than errors that are too large: only
        the sandwich is used if chance explains less than half of the difference.  Distances are
        measured in units of the likelihood's covariance, which replaces Ledoit and Wolf's identity
        matrix, so that the result does not depend on the parametrisation.
        """
        whitened = self.covariance @ (self.unbiased - self.scale * self.expected)
        distance = float(np.sum(whitened * whitened.T))
        squares, crossed, expected = self.products
        by_chance = squares - 2 * self.scale * crossed + self.scale**2 * expected
        return float(np.clip(2 * (1 - by_chance / distance), 0.0, 1.0)) if distance > 0 else 0.0

    def sandwich(self, weight: float = 1.0) -> Float:
        """Covariance (D, D) with this weight of the jackknife and the rest from the likelihood."""
        meat = weight * self.jackknife + (1 - weight) * self.scale * self.expected + self.prior
        return np.asarray(self.covariance @ meat @ self.covariance)

    @property
    def by_evidence(self) -> Float:
        """Covariance (D, D) with the weight `weight`."""
        return self.sandwich(self.weight)
