"""Covariance of parameters by the scatter of the stars, as far as they show that it is needed.

The sandwich A^-1 (sum of g g^T) A^-1 is valid for any variances of single stars, but its elements
scatter as sums of squares do.  Squared scores divided by (1 - l)^2, with l the leverage of a star
(HC3 of MacKinnon and White 1985, Journal of Econometrics 29, 305), hold with stars of high leverage
that are worse than others, and are 1 / (1 - l) times too large where all stars are alike.  Then the
likelihood's own covariance, times one factor for all stars, is exact.
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
    """Sums over the stars of products of their scores, and the likelihood's prediction of them.

    X : Y below is the sum over stars of the products of matrices X_i and Y_i, trace(A^-1 X_i A^-1
    Y_i), where X_i is what a star adds to a sum and A is the information of the parameters.
    """

    covariance: Float  # (D, D) A^-1 of the parameters, by likelihood and priors
    expected: Float  # (D, D) information of the likelihood: expected sum of squares
    prior: Float  # (D, D) information of the priors
    # (D, D) each score divided by the root of 1 - l (HC2): of the right mean if all stars are alike
    unbiased: Float
    jackknife: Float  # (D, D) each score divided by 1 - l (HC3)
    # unbiased : unbiased, unbiased : expected, and expected : expected
    products: tuple[float, float, float]

    @cached_property
    def scale(self) -> float:
        """Mean ratio of the squares to those that are expected."""
        return float(np.sum(self.covariance * self.unbiased)) / float(
            np.sum(self.covariance * self.expected)
        )

    @cached_property
    def weight(self) -> float:
        """Weight of the sandwich: 0 if the stars show no differences of their variances.

        With d the squared distance of the unbiased sum from `scale` times the expected one, and b
        the part of d that is due to the scatter of single squares, 1 - b / d is the weight of
        linear shrinkage with the least expected squared error (Ledoit and Wolf 2004, Journal of
        Multivariate Analysis 88, 365; James and Stein's estimator as an empirical Bayes estimate:
        Efron and Morris 1973, Journal of the American Statistical Association 68, 117).  It is
        doubled, since errors that are too small are worse than errors that are too large: the
        sandwich stands alone once chance explains less than half of the difference.  Distances are
        measured in units of the likelihood's covariance, which takes the place of Ledoit and Wolf's
        identity matrix, so that parameters may be chosen in any way.
        """
        whitened = self.covariance @ (self.unbiased - self.scale * self.expected)
        distance = float(np.sum(whitened * whitened.T))
        squares, crossed, expected = self.products
        by_chance = squares - 2 * self.scale * crossed + self.scale**2 * expected
        return float(np.clip(2 * (1 - by_chance / distance), 0.0, 1.0)) if distance > 0 else 0.0

    def sandwich(self, weight: float = 1.0) -> Float:
        """Covariance (D, D) with this weight of the jackknife, the rest that of the likelihood."""
        meat = weight * self.jackknife + (1 - weight) * self.scale * self.expected + self.prior
        return np.asarray(self.covariance @ meat @ self.covariance)

    @property
    def by_evidence(self) -> Float:
        """Covariance (D, D) by `weight`."""
        return self.sandwich(self.weight)
