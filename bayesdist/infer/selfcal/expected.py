"""What exposures would tell before any is taken: the Fisher information at a truth.

Where stars fall is all that matters: residuals enter the curvature of the log density only through
memberships, and here every detection lies on its star.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.detections import Detections
from bayesdist.infer.selfcal.gauge import Gauge, find_gauge
from bayesdist.infer.selfcal.information import Information
from bayesdist.infer.selfcal.normal import Mixture, expand
from bayesdist.infer.selfcal.problem import Problem, prepared
from bayesdist.infer.selfcal.relative import gauge_free_matrix
from bayesdist.model import DistortionModel

__all__ = ["ExpectedSolution", "expected_solution"]

Float = NDArray[np.float64]

BOUNDED = 1e-3  # of a free direction that others may leave of it and still describe it
NONE_FALSE = Mixture(jitter=0.0, fraction=1e-300)


@dataclass(frozen=True, eq=False)
class ExpectedSolution:
    """A solution as it would come out, without noise: its mean is the truth.

    Parameters
    ----------
    model : DistortionModel
    mean : ndarray, shape (D,)
        The truth.
    cov : ndarray, shape (D, D)
        Zero for what the gauge holds.
    gauge : Gauge
    problem : Problem
        The detections that would be used, sorted by star.
    """

    model: DistortionModel
    mean: Float
    cov: Float
    gauge: Gauge
    problem: Problem

    def draws(self, n: int, rng: np.random.Generator) -> Float:
        """Parameter vectors (n, D)."""
        return np.asarray(rng.multivariate_normal(self.mean, self.cov, n, method="eigh"))

    def up_to(self, directions: Float) -> Float | None:
        """Covariance (D, D) of what is left when some directions do not count.

        Parameters
        ----------
        directions : ndarray, shape (D, d)
            As of `gauge_free_matrix`.

        Returns
        -------
        ndarray, or None
            None where other directions are open than these: then nothing bounds the errors.
        """
        S = gauge_free_matrix(self.model, self.mean, directions)
        open_ = self.gauge.open
        if open_.shape[1] and _largest(S @ open_, self.model) > BOUNDED * _largest(
            open_, self.model
        ):
            return None
        return np.asarray(S @ self.cov @ S.T)


def _largest(change: Float, model: DistortionModel) -> float:
    """Largest coefficient of the polynomials in some changes (D, k) of the parameters."""
    return float(np.abs(change[: model.n_polynomial]).max())


def expected_solution(
    model: DistortionModel,
    truth: Float,
    detections: Detections,
    information: Information,
    *,
    least: int = 2,
) -> ExpectedSolution:
    """The covariance that a self-calibration would have, its stars marginalised.

    Parameters
    ----------
    model : DistortionModel
    truth : ndarray, shape (D,)
    detections : Detections
        Where stars fall, with their codes and errors; no noise.
    information : Information
        What will be known beside them.
    least : int
        Fewest detections of a star.

    Raises
    ------
    InputError
        When no star is seen often enough.
    """
    # false detections are not drawn, so that their reach does not matter
    problem = prepared(model, detections, truth, match_radius=1.0, least=least)
    stars = problem.mean_places(truth)
    problem = problem.at(truth, stars)
    curvature = expand(problem, truth, NONE_FALSE, stars).curvature
    gauge = find_gauge(problem, truth, curvature, information)
    free = np.setdiff1d(np.arange(model.n_params), gauge.held)
    precision = (curvature + information.precision)[np.ix_(free, free)]
    scale = 1.0 / np.sqrt(np.diag(precision))
    cov = np.zeros_like(curvature)
    cov[np.ix_(free, free)] = np.linalg.inv(precision * np.outer(scale, scale)) * np.outer(
        scale, scale
    )
    return ExpectedSolution(model, np.array(truth, float), cov, gauge, problem)
