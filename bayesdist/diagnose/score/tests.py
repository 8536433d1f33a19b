"""Tests of one solution, corrected for their number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.diagnose.score.exposures import exposure_test
from bayesdist.diagnose.score.families import FAMILIES
from bayesdist.diagnose.score.gap import gap_test
from bayesdist.diagnose.score.motions import motion_test
from bayesdist.diagnose.score.noise import noise_tests
from bayesdist.diagnose.score.pattern import pattern_test
from bayesdist.diagnose.score.projection import projection_of
from bayesdist.diagnose.score.regressor_tests import regressor_tests
from bayesdist.diagnose.score.regressors import EDGES, EDGES_ADJUSTED, functions_for
from bayesdist.diagnose.score.result import Outcome, ScoreTest, corrected
from bayesdist.diagnose.score.sample import scored_sample
from bayesdist.diagnose.score.truncation import truncation_test
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.solution import Solution
from bayesdist.limits import SCORE_TESTS

__all__ = ["score_tests"]

SAYS_NOTHING = 0.2  # probability by chance above which a second look has seen nothing
OF_TIME = ("drift", "curvature in time", "motions")
ORDERS, OF_PLACE = "order ", "noise by position"


def score_tests(
    table: Matches,
    solution: Solution,
    *,
    priors: GaussianPriors | None = None,
    match_radius: float | None = None,
) -> tuple[ScoreTest, ...]:
    """Targeted tests for what a model lacks, and for noise that is not as the errors say.

    A test is left out where the data cannot be asked: without magnitudes or dates, of one exposure,
    with too few stars.

    Parameters
    ----------
    table : Matches
        The matches that the solution was made from, or some of them; of more than `SAMPLE` rows,
        every k-th is taken, and the tests are as strong as that sample is.
    solution : Posterior or LinearFit
    priors : GaussianPriors, optional
        Those of the solution; flat by default.
    match_radius : float, optional
        Within which the stars were matched, in the unit of u and v.

    Returns
    -------
    tuple of ScoreTest

    Raises
    ------
    InputError
        When the table does not go with the solution's model, or the solution does not say how it
        was fitted.
    """
    projection = projection_of(
        functions_for(scored_sample(table, solution)),
        np.asarray(solution.mean, float),
        priors or GaussianPriors.none(solution.model),
    )
    exposures = exposure_test(projection)
    found = _edges_or_orders(regressor_tests(projection))
    sample = projection.scored
    found += [one for one in (gap_test(projection), motion_test(sample)) if one is not None]
    if exposures is not None and exposures.p_value < SCORE_TESTS.value:
        # so few dates may go with time too
        clause = "it is not single exposures that deviate"
        found = [one.unless(clause) if one.name in OF_TIME else one for one in found]
    orders = [one.p_value for one in found if one.name.startswith(ORDERS)]
    found += noise_tests(sample)
    if min(orders, default=1.0) < SCORE_TESTS.value:  # which look the same
        clause = "it is not the missing order"
        found = [one.unless(clause) if one.name == OF_PLACE else one for one in found]
    others = (exposures, pattern_test(sample), truncation_test(sample, match_radius))
    return corrected([*found, *(one for one in others if one is not None)])


def _edges_or_orders(outcomes: list[Outcome]) -> list[Outcome]:
    """Outcomes with one test of the edges: the one adjusted for orders, where that says nothing.

    A missing order rises towards the edges as well.  Adjusted for the orders there is less to be
    seen of what does so by itself, but something.
    """
    by_name = {one.name: one for one in outcomes}
    adjusted = by_name.pop(EDGES_ADJUSTED, None)
    if EDGES in by_name and adjusted is not None and adjusted.p_value > SAYS_NOTHING:
        by_name[EDGES] = replace(adjusted, family=FAMILIES[EDGES])
    return list(by_name.values())
