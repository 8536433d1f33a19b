"""Expected covariance for planned exposures: the Fisher information at assumed true parameters.

The information depends only on the positions of the stars.  Residuals would enter it only through
the membership probabilities, and here all detections are at the positions of their stars.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.data.detections import Detections
from bayesdist.infer.equations.priors import Prior
from bayesdist.infer.selfcal.elimination import Mixture, expand
from bayesdist.infer.selfcal.gauge import Gauge, find_gauge
from bayesdist.infer.selfcal.problem import Problem, prepare
from bayesdist.infer.selfcal.sky_moves import gauge_free_matrix
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float
from bayesdist.utils.quantities import Random, generator_of

BOUNDED = 1e-3  # largest unexplained fraction of a free direction for bounded errors
NONE_FALSE = Mixture(jitter=0.0, fraction=1e-300)


@dataclass(frozen=True, eq=False)
class ExpectedSolution(Solution):
    """Expected solution: its mean is the assumed truth, its covariance the expected one."""

    model: DistortionModel
    mean: Float  # true parameters (D,)
    cov: Float  # covariance (D, D); zero for parameters that the gauge fixes
    gauge: Gauge
    problem: Problem  # detections that would be used, sorted by star

    def draws(self, n: int, rng: Random) -> Float:
        """Draws (n, D) from the Gaussian with this mean and covariance; see `Solution.draws`."""
        generator = generator_of(rng)
        return np.asarray(generator.multivariate_normal(self.mean, self.cov, n, method="eigh"))

    def up_to(self, directions: Float) -> Float:
        """Covariance (D, D) without errors along the directions (D, d); see `gauge_free_matrix`.

        It is meaningful only if `bounded_by` is True for these directions.
        """
        S = gauge_free_matrix(self.model, self.mean, directions)
        return np.asarray(S @ self.cov @ S.T)

    def bounded_by(self, directions: Float) -> bool:
        """True if errors are bounded apart from those along the given directions (D, d)."""
        free, model = self.gauge.open, self.model
        if not free.shape[1]:
            return True
        remainder = gauge_free_matrix(model, self.mean, directions) @ free
        return _largest(remainder, model) <= BOUNDED * _largest(free, model)


def _largest(change: Float, model: DistortionModel) -> float:
    """Largest absolute change of a polynomial coefficient in changes (D, k) of the parameters."""
    return float(np.abs(change[: model.n_polynomial]).max())


def expected_solution(
    model: DistortionModel,
    truth: Float,
    detections: Detections,
    prior: Prior,
    *,
    min_detections: int = 2,
) -> ExpectedSolution:
    """Compute the expected covariance of a self-calibration, marginalised over the stars.

    `truth` (D,) are the true parameters.  `detections` are the noise-free positions of stars, with
    star codes and errors; `prior` is information from other sources; `min_detections` is the
    minimum number of detections of a star.  Raises InputError if no star has enough detections.
    """
    problem, curvature = _expanded(model, truth, detections, min_detections)
    gauge = find_gauge(problem, truth, curvature, prior)
    free = np.setdiff1d(np.arange(model.n_params), gauge.held)
    precision = (curvature + prior.precision)[np.ix_(free, free)]
    scale = 1.0 / np.sqrt(np.diag(precision))
    cov = np.zeros_like(curvature)
    cov[np.ix_(free, free)] = np.linalg.inv(precision * np.outer(scale, scale)) * np.outer(
        scale, scale
    )
    return ExpectedSolution(model, np.array(truth, float), cov, gauge, problem)


def expected_curvature(model: DistortionModel, truth: Float, detections: Detections) -> Float:
    """Curvature (D, D) of the log-likelihood by all parameters, its stars marginalised.

    Arguments are as of `expected_solution`.
    """
    return _expanded(model, truth, detections, 2)[1]


def _expanded(
    model: DistortionModel, truth: Float, detections: Detections, min_detections: int
) -> tuple[Problem, Float]:
    """Problem of detections without noise, and the curvature (D, D) of its log-likelihood."""
    # there are no false detections, so the match radius does not matter
    problem = prepare(model, detections, truth, match_radius=1.0, min_detections=min_detections)
    stars = problem.mean_places(truth)
    problem = problem.at(truth, stars)
    return problem, expand(problem, truth, NONE_FALSE, stars)[0].curvature
