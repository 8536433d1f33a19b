"""Information of exposures before any is taken: the Fisher information at a truth.

Only the positions of the stars matter: residuals enter the curvature of the log density only
through memberships, and here every detection lies on its star.
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

BOUNDED = 1e-3  # fraction of a free direction that the others may leave unexplained
NONE_FALSE = Mixture(jitter=0.0, fraction=1e-300)


@dataclass(frozen=True, eq=False)
class ExpectedSolution(Solution):
    """Expected solution without noise: its mean is the truth."""

    model: DistortionModel
    mean: Float  # the truth (D,)
    cov: Float  # (D, D) zero for parameters that the gauge fixes
    gauge: Gauge
    problem: Problem  # detections that would be used, sorted by star

    def draws(self, n: int, rng: Random) -> Float:
        """Parameter vectors (n, D)."""
        generator = generator_of(rng)
        return np.asarray(generator.multivariate_normal(self.mean, self.cov, n, method="eigh"))

    def up_to(self, directions: Float) -> Float:
        """Covariance (D, D) without the errors along directions (D, d), as of `gauge_free_matrix`.

        No number of it means anything unless these directions bound the errors.
        """
        S = gauge_free_matrix(self.model, self.mean, directions)
        return np.asarray(S @ self.cov @ S.T)

    def bounded_by(self, directions: Float) -> bool:
        """Boolean: no directions are open but these (D, d); else nothing bounds the errors."""
        free, model = self.gauge.open, self.model
        if not free.shape[1]:
            return True
        left = gauge_free_matrix(model, self.mean, directions) @ free
        return _largest(left, model) <= BOUNDED * _largest(free, model)


def _largest(change: Float, model: DistortionModel) -> float:
    """Largest coefficient of the polynomials in some changes (D, k) of the parameters."""
    return float(np.abs(change[: model.n_polynomial]).max())


def expected_solution(
    model: DistortionModel,
    truth: Float,
    detections: Detections,
    prior: Prior,
    *,
    min_detections: int = 2,
) -> ExpectedSolution:
    """Covariance that a self-calibration would have, its stars marginalised.

    `detections` have the positions of stars, their codes and errors, and no noise; `prior` is from
    other sources; `min_detections` are those of a star.  InputError when no star is
    seen often enough.
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
    # false detections are not drawn, so that their largest distance does not matter
    problem = prepare(model, detections, truth, match_radius=1.0, min_detections=min_detections)
    stars = problem.mean_places(truth)
    problem = problem.at(truth, stars)
    return problem, expand(problem, truth, NONE_FALSE, stars)[0].curvature
