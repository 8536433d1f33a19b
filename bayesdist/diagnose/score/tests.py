"""All score tests of one solution, corrected for their number."""

from __future__ import annotations

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.diagnose.score.exposures import exposure_field_test, exposure_tests
from bayesdist.diagnose.score.missing_orders import chip_residuals, missing_orders_test
from bayesdist.diagnose.score.motions import gap_test, motion_test
from bayesdist.diagnose.score.noise import noise_tests
from bayesdist.diagnose.score.patterns import jump_test, pattern_test, ring_test
from bayesdist.diagnose.score.projection import projection_of, regressor_tests
from bayesdist.diagnose.score.questions import HIGHER, functions_for, order_family
from bayesdist.diagnose.score.result import ScoreTest, corrected
from bayesdist.diagnose.score.sample import SAMPLE, scored_sample
from bayesdist.diagnose.score.shape import shape_tests
from bayesdist.diagnose.score.truncation import radius_test, truncation_test
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.solution.solution import Solution
from bayesdist.utils.checks import SCORE_TESTS


def score_tests(
    table: Matches,
    solution: Solution,
    *,
    priors: GaussianPriors | None = None,
    match_radius: float | None = None,
    sample_size: int = SAMPLE,
) -> tuple[ScoreTest, ...]:
    """Test for effects that a model lacks, and for noise that differs from the stated errors.

    Tests that the data do not allow are left out, for example without magnitudes or dates, with a
    single exposure, or with too few stars.

    Parameters
    ----------
    table : Matches
        The N matches that the solution was made from, or a part of them.  If there are more than
        `sample_size` rows, every k-th is used, and the power of the tests is that of this sample.
    solution : Posterior or LinearFit
        The solution to test.
    priors : GaussianPriors, optional
        Priors of the solution; flat by default.
    match_radius : float, optional
        Radius within which the stars were matched, in the unit of u and v.
    sample_size : int, optional
        Largest number of detections that are tested.

    Returns
    -------
    tuple of ScoreTest
        Results in a fixed order.

    Raises
    ------
    InputError
        If the table does not match the solution's model, or if the solution does not say how it was
        fitted.
    """
    priors, mean = priors or GaussianPriors.none(solution.model), np.asarray(solution.mean, float)
    projection = projection_of(
        functions_for(scored_sample(table, solution, match_radius, size=sample_size)), mean, priors
    )
    sample = projection.scored
    chips = chip_residuals(sample)
    regressed = regressor_tests(projection)
    level = SCORE_TESTS.value / max(len(regressed), 1)
    significant = {result.name for result in regressed if result.p_value < level}
    order = sample.model.order
    at_least = max(
        (
            total
            for total in range(order, order + HIGHER + 1)
            if order_family(total, order).name in significant
        ),
        default=order,
    )
    outcomes = [
        truncation_test(sample, match_radius),
        radius_test(sample),
        *shape_tests(sample, chips),
        *regressed,
        missing_orders_test(sample, chips, at_least),
        gap_test(projection),
        jump_test(sample),
        motion_test(sample),
        *noise_tests(sample),
        *exposure_tests(projection, mean, priors),
        exposure_field_test(sample),
        pattern_test(sample),
        ring_test(sample),
    ]
    return corrected([outcome for outcome in outcomes if outcome is not None])
