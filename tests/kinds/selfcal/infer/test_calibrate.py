"""Iterations of grouping and solution."""

from __future__ import annotations

import weakref

from bayesdist.kinds.selfcal.infer import self_calibrate
from tests.kinds.selfcal.infer.fields import field


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
