"""Exposures that a requirement needs: by closed forms, and by fits of so many."""

import numpy as np
import pytest
from scipy import stats

from bayesdist.assess import Requirement, UserTerm, check_requirements
from bayesdist.assess.model import error_model
from bayesdist.assess.planning import (
    MOST,
    TRUTHS,
    ExistingData,
    Futures,
    Scattering,
    Schedule,
    exposures_needed,
    with_more_data,
)
from bayesdist.infer import fit_linear
from bayesdist.infer.compare.planning import (
    exposure_content,
    exposure_information,
    with_information,
)
from bayesdist.kinds.selfcal.diagnose.eliminated import (
    AddedColumns,
    EvenStars,
    eliminated,
    scores_of_detections,
)
from bayesdist.kinds.selfcal.infer.mode import of_first
from bayesdist.kinds.selfcal.patterns.dithers import further_dithers
from bayesdist.model.alignment import mean_squares
from tests.infer.compare.test_planning import SIGMA, model_of, stars
from tests.kinds.selfcal.diagnose.test_correlated import solution_of
from tests.kinds.selfcal.infer.fields import field
from tests.reduced import case_in_full


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


def needed(fit, schedule, probability_met, asked):
    """Need of a schedule whose exposures make the covariance of a fit smaller."""

    def reached(one):
        return lambda n: probability_met(with_information(fit, n * one.information))

    [found] = exposures_needed([schedule], reached, asked, now=probability_met(fit))
    return found


def test_as_many_exposures_as_were_planned_meet_the_requirement():
    """The plan is made with two exposures; fits of two and as many more as it says are judged."""
    matches, fit = fitted(2, seed=1)
    now = check_requirements(
        fit, [Requirement("r", "p95", 1.0)], grid=(9, 5), rng=np.random.default_rng(1)
    )[0]
    asked = 0.9
    need = Requirement("r", "p95", 0.5 * float(np.quantile(now.draws, asked)), probability=asked)
    found = needed(fit, schedule_of(matches, fit, 2), judge(need), need.probability)
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
    found = needed(fit, schedule_of(matches, fit, 2), judge(Requirement("r", "max", 1.0)), 0.95)
    assert found.exposures == 0
    assert "met as it is" in found.sentence


def test_no_number_of_exposures_makes_the_catalogue_better():
    matches, fit = fitted(2, seed=1)
    term = [UserTerm("catalogue", "systematic", SIGMA, SIGMA)]
    limit = SIGMA * stats.rayleigh.ppf(0.5)
    found = needed(
        fit,
        schedule_of(matches, fit, 2),
        judge(Requirement("r", "max", limit), terms=term),
        0.95,
    )
    assert found.exposures is None
    assert found.probability < 0.6
    assert f"{MOST} more exposures" in found.sentence


def test_the_number_is_the_smallest():
    """A probability that is a known step of the information."""
    matches, fit = fitted(2, seed=1)
    schedule = schedule_of(matches, fit, 2)
    for n in (1, 2, 3, 7, 64, 1000):
        # one exposure of two adds half of the information: cov / (1 + n / 2)
        limit = fit.sigma[0] / np.sqrt(1 + (n - 0.5) / 2)

        def small_enough(solution, limit=limit):
            return float(np.sqrt(solution.cov[0, 0]) <= limit)

        found = needed(fit, schedule, small_enough, 0.5)
        assert found.exposures == n
        assert found.interval == (n, n)  # of a step


def futures_of(fit, requirement, *, terms=(), n_stars=1500.0):
    """Runs with more exposures than the two of a fit, of whose stars all is known."""
    return Futures(
        error_model(fit, terms),
        requirement,
        ExistingData(2, n_stars / SIGMA**2, n_stars),
        lambda information: with_information(fit, information),
        (9, 5),
        None,
        None,
        seed=5,
    )


def test_without_other_errors_the_future_is_that_of_the_covariance():
    """Errors half as large take four times the data; far fewer miss, and far more meet."""
    matches, fit = fitted(2, seed=1)
    asked = 0.9
    now = check_requirements(
        fit, [Requirement("r", "p95", 1.0)], grid=(9, 5), rng=np.random.default_rng(1)
    )[0]
    need = Requirement("r", "p95", 0.5 * float(np.quantile(now.draws, asked)), probability=asked)
    futures, schedule = futures_of(fit, need), schedule_of(matches, fit, 2)
    assert futures.met(schedule, 3, np.arange(TRUTHS)).mean() < 0.1
    assert futures.met(schedule, 12, np.arange(TRUTHS)).mean() > 0.9


def test_a_stated_catalogue_is_the_same_in_all_futures():
    matches, fit = fitted(2, seed=1)
    need = Requirement("r", "max", SIGMA * stats.rayleigh.ppf(0.5))
    term = UserTerm("catalogue", "systematic", SIGMA, SIGMA)
    futures = futures_of(fit, need, terms=[term])
    assert futures.probability(schedule_of(matches, fit, 2))(MOST) == 0


def test_the_posterior_of_normal_data_is_found_with_more_of_them():
    """A mean with a flat prior: the variance of its posterior, and of the mean of that."""
    rng, n, rho = np.random.default_rng(3), 4000, 3.0
    today = 2.0 + 0.5 * rng.standard_normal(n)
    means = []
    for truth, noise in rng.integers(n, size=(n, 2)):
        after = with_more_data(today, rho, truth, noise)
        means.append(after.mean())
    # four times the data; the spread is that of 4000 numbers, to 1.1 %
    np.testing.assert_allclose(after.std(), 0.25, rtol=0.045)
    # what one posterior loses in variance its mean has: the law of total variance
    np.testing.assert_allclose(np.var(means), 0.25 - 0.0625, rtol=0.09)
    np.testing.assert_allclose(np.mean(means), 2.0, atol=4 * 0.5 / np.sqrt(n))


def test_scatters_follow_from_deviations_as_bayes_theorem_has_it():
    """By the inverse gamma posterior of a variance whose prior is flat in the logarithm."""
    rng = np.random.default_rng(4)
    variance = np.geomspace(1e-2, 1e2, 6001)
    scattering = Scattering(None, None, variance[:, None])
    data = ExistingData(2, 1e12, 100.0)  # deviations are measured without error
    means = []
    truth = len(variance) // 2  # of variance 1
    for _ in range(150):
        rows = scattering.chosen(40, data, truth, rng)
        # degrees of freedom times the inverse variance is chi-square, of mean 40 / the mean square
        precision = 1 / variance[rows]
        means.append(precision.mean())
        assert abs(precision.std() / precision.mean() / np.sqrt(2 / 40) - 1) < 0.1
    # the mean of 40 / chi-square of 40 is 40 / 38, its scatter 0.25
    assert abs(np.mean(means) - 40 / 38) < 4 * 0.25 / np.sqrt(150)


def effect_of_deviations(mode):
    """Rms over the detector of the polynomials' response to deviations of unit scatter."""
    even = EvenStars.of(mode)
    columns = AddedColumns(even.problem, mode.theta, {}, even.deviating())
    scores = scores_of_detections(mode).at(even.rows)
    information, _, _ = eliminated(columns, scores, even.stars)
    n, model = len(mode.theta), mode.problem.model
    response = (mode.cov @ information[:n, n:])[: model.n_polynomial]
    return np.sqrt(mean_squares(model) @ (response**2).sum(axis=1))


def test_every_possible_scatter_is_given_all_patterns():
    """Deviations proportional to their scatter: chosen draws differ from others in size alone."""
    rng = np.random.default_rng(6)
    scatter = np.exp(rng.standard_normal(250))
    scattering = Scattering(None, None, scatter[:, None] ** 2)
    pattern = rng.standard_normal((250, 5, 2))
    rows = np.repeat([3, 7], 125)
    expected = scatter[rows][:, None, None] * pattern
    np.testing.assert_allclose(
        scattering.resized(scatter[:, None, None] * pattern, rows), expected, rtol=1e-12
    )


def test_truths_are_drawn_with_their_odds():
    rng = np.random.default_rng(7)
    odds = np.array([1.0, 2.0, 5.0])
    scattering = Scattering(None, None, np.ones((3, 1)), odds=odds)
    drawn = [scattering.truth(uniform) for uniform in rng.uniform(size=8000)]
    share = np.bincount(drawn, minlength=3) / 8000
    np.testing.assert_allclose(share, odds / 8, atol=4 * 0.5 / np.sqrt(8000))


@pytest.mark.parametrize("seed", [1, case_in_full(3, instead="another seed is run")])
def test_further_dithers_say_what_exposures_that_are_simulated_do(seed):
    """Of the same field, 38 exposures in place of 6: more than 38 / 6 times the information.

    The effect of deviations of exposures is that of the derivatives with respect to these, which
    the diagnostics of a self-calibration use.
    """
    few, many = (
        solution_of(field(seed + k, n, sigma=0.02, n_stars=2000)) for k, n in ((0, 6), (100, 38))
    )
    n = few.problem.model.n_distortion
    free = [mode.free[mode.free < n] for mode in (few, many)]
    at = np.ix_(*[np.intersect1d(*free)] * 2)

    def rms(information):
        return np.sqrt(np.trace(np.linalg.inv(information[at])))

    # exposures see as many stars in either
    density = len(few.problem) / 6 / (len(many.problem) / 38)
    simulated = rms(density * many.distortion_information)
    several = further_dithers(few, seed)
    now = of_first(few.expansion.curvature, few.free, few.problem.model.n_params)
    predicted = [rms(of_first(now + one.information(32), few.free, n)) for one in several]
    assert abs(np.median(predicted) / simulated - 1) < 0.12
    assert np.ptp(predicted) > 0.01 * simulated
    assert rms(few.distortion_information * 38 / 6) > 1.15 * simulated
    # deviations of exposures move the fit by about the inverse root of their number
    effect = effect_of_deviations(many) / effect_of_deviations(few)
    np.testing.assert_allclose([one.deviations(32) for one in several], effect, rtol=0.08)
    ratio = several[0].deviations(200) / several[0].deviations(64)
    np.testing.assert_allclose(ratio, np.sqrt((6 + 64) / (6 + 200)))
    # between the numbers for which it is computed, and beyond them
    low, middle, high = (several[0].information(k)[at] for k in (16, 24, 32))
    np.testing.assert_allclose(middle, (low + high) / 2, atol=1e-9 * np.abs(high).max())
    assert (
        np.linalg.eigvalsh(several[0].information(200)[at] - several[0].information(64)[at]) > 0
    ).all()
