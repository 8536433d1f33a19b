"""Iterations of grouping and solution."""

from __future__ import annotations

import weakref

import numpy as np
import pytest

from bayesdist.data import ReferenceCatalog
from bayesdist.kinds.selfcal.infer import self_calibrate
from bayesdist.kinds.selfcal.infer.prior import ReferenceStars
from tests.kinds.selfcal.infer.fields import field, problem_of


def test_an_iteration_holds_no_detections_of_the_last():
    """Else the peak of the memory is a third higher."""
    simulated, errors, still_held = field(1, 6, 200, order=1), [], []

    def references(problem, theta):
        still_held.append([k for k, one in enumerate(errors) if one() is not None])
        errors.append(weakref.ref(problem.var))
        return problem.priors

    self_calibrate(
        simulated.model,
        simulated.unlabelled,
        simulated.theta,
        match_radius=1.0,
        start_radius=4.0,
        references=references,
    )
    assert len(still_held) > 2
    assert still_held == [[]] * len(still_held)


@pytest.mark.parametrize("motion", ["none", "proper_motion"])
def test_reference_stars_have_the_covariances_of_the_catalogue(motion):
    """Of positions or, if motions are fitted, of both at the mean date of the exposures."""
    simulated = field(2, 6, 300, epochs=np.linspace(2020, 2022, 6))
    problem, _ = problem_of(simulated, motion=motion)
    n, rng = len(simulated.sky), np.random.default_rng(46)
    root = rng.standard_normal((n, 5, 5))
    C = 1e-4 * (root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(5))
    sigma = np.sqrt(np.einsum("nii->ni", C))
    zero = np.zeros(n)
    catalog = ReferenceCatalog(
        *simulated.sky.T, pm_u=zero, pm_v=zero, epoch=2016.0,
        sigma_u=sigma[:, 0], sigma_v=sigma[:, 1], sigma_pm_u=sigma[:, 3], sigma_pm_v=sigma[:, 4],
        correlations=C / (sigma[:, :, None] * sigma[:, None]),
    )  # fmt: skip
    priors = ReferenceStars(catalog, 2.0)(problem, simulated.theta)
    A = np.eye(5)
    A[0, 3] = A[1, 4] = 0.0 if motion == "none" else 2021.0 - 2016.0
    which = [0, 1, 3, 4][: problem.n_star]
    then = (A @ C @ A.T)[:, which][:, :, which]
    whose = simulated.detections.star[problem.rows[problem.starts[:-1]]]
    known = priors.informed & (whose >= 0)
    assert known.sum() > 100
    expected = np.linalg.inv(then[whose[known]])
    np.testing.assert_allclose(priors.precision[known], expected, rtol=1e-5)
