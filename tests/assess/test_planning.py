"""Exposures that a requirement needs: by closed forms, and by fits of so many."""

import numpy as np
from scipy import stats

from bayesdist.assess import Requirement, UserTerm, check_requirements
from bayesdist.assess.planning.exposures import MOST, Schedule, exposures_needed
from bayesdist.infer import fit_linear
from bayesdist.infer.compare.planning import exposure_content, exposure_information
from tests.infer.compare.test_planning import SIGMA, model_of, stars


def judge(requirement, **options):
    def probability_met(solution):
        [m] = check_requirements(
            solution,
            [requirement],
            grid=(9, 5),
            n_draws=2000,
            rng=np.random.default_rng(11),
            **options,
        )
        return m.probability_met

    return probability_met


def fitted(n_exposures, seed, n=1500):
    matches = stars([2010.0] * n_exposures, n, np.random.default_rng(seed))
    return matches, fit_linear(matches, model_of(matches))


def schedule_of(matches, fit, n_exposures):
    weight = np.stack([matches.sigma_u, matches.sigma_v], axis=1) ** -2.0
    content = exposure_content(fit.model, matches, weight, n_exposures=n_exposures)
    return Schedule("again", exposure_information(fit, content, None))


def test_as_many_exposures_as_were_planned_meet_the_requirement():
    """The plan is made with two exposures; fits of two and as many more as it says are judged."""
    matches, fit = fitted(2, seed=1)
    now = check_requirements(
        fit, [Requirement("r", "p95", 1.0)], grid=(9, 5), rng=np.random.default_rng(1)
    )[0]
    asked = 0.9
    need = Requirement("r", "p95", 0.5 * float(np.quantile(now.draws, asked)), probability=asked)
    [found] = exposures_needed(fit, [schedule_of(matches, fit, 2)], judge(need), need.probability)
    # errors half as large take four times the data: six more than the two
    assert found.exposures in (5, 6, 7)
    assert "more exposures" in found.sentence
    met = [judge(need)(fitted(2 + found.exposures, seed)[1]) for seed in range(20, 26)]
    fewer = [judge(need)(fitted(found.exposures, seed)[1]) for seed in range(30, 36)]
    # sums over 3000 stars, with which it was planned, scatter by 2 %; in the probability by 0.01
    assert np.mean(met) > asked - 0.02
    assert np.mean(fewer) < asked < np.mean(met) + 0.02


def test_what_is_met_needs_nothing_more():
    matches, fit = fitted(2, seed=1)
    [found] = exposures_needed(
        fit, [schedule_of(matches, fit, 2)], judge(Requirement("r", "max", 1.0)), 0.95
    )
    assert found.exposures == 0
    assert "met as it is" in found.sentence


def test_no_number_of_exposures_makes_the_catalogue_better():
    matches, fit = fitted(2, seed=1)
    term = [UserTerm("catalogue", "systematic", SIGMA, SIGMA)]
    limit = SIGMA * stats.rayleigh.ppf(0.5)
    [found] = exposures_needed(
        fit,
        [schedule_of(matches, fit, 2)],
        judge(Requirement("r", "max", limit), terms=term),
        0.95,
    )
    assert found.exposures is None
    assert found.probability < 0.6
    assert f"{MOST} exposures" in found.sentence


def test_the_number_is_the_smallest():
    """A probability that is a known step of the information."""
    matches, fit = fitted(2, seed=1)
    schedule = schedule_of(matches, fit, 2)
    for n in (1, 2, 3, 7, 64, 1000):
        # one exposure of two adds half of the information: cov / (1 + n / 2)
        limit = fit.sigma[0] / np.sqrt(1 + (n - 0.5) / 2)

        def small_enough(solution, limit=limit):
            return float(np.sqrt(solution.cov[0, 0]) <= limit)

        [found] = exposures_needed(fit, [schedule], small_enough, 0.5)
        assert found.exposures == n
