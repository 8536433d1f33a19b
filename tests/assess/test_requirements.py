import tracemalloc
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats

from bayesdist.assess import STATISTICS, Requirement, UserTerm
from bayesdist.assess.requirements.verdict import Tally
from bayesdist.assess.terms.forms import Pool
from bayesdist.diagnose.statistics import clopper_pearson
from bayesdist.errors import InputError
from bayesdist.infer.posterior.checks import scatter_too_small
from bayesdist.model import Chip, DistortionModel
from bayesdist.utils.checks import EITHER, LARGER, Check
from tests.reduced import case_in_full

from .by_draws import margins_by_draws

RADIAL = [s for s in STATISTICS if s[:2] not in ("u_", "v_")]
S = 0.03
SYSTEMATIC = [UserTerm("offset", "systematic", S, S)]
RANDOM = [UserTerm("centroids", "random", S, S)]


def margins_of(s, reqs, seed=1, **options):
    return margins_by_draws(s, reqs, rng=np.random.default_rng(seed), **options)


def near(counted, n, probability):
    """Within five standard errors of a count."""
    return abs(counted - probability) < 5 * np.sqrt(probability * (1 - probability) / n) + 1e-12


@pytest.fixture
def exact(solution_of):
    """A solution without error."""
    return solution_of(DistortionModel(1, (Chip(1, "A", (100.0, 80.0), (50.0, 40.0)),)))


@pytest.fixture
def shifting(solution_of):
    """A solution whose only error is a common shift of the field, S on each axis."""
    cov = np.zeros((6, 6))
    cov[0, 0] = cov[3, 3] = S**2
    model = DistortionModel(1, (Chip(1, "A", (100.0, 80.0), (50.0, 40.0)),))
    return lambda **c: solution_of(model, cov=cov, **c)


# -- the distribution of the statistics ------------------------------------------------------------


@pytest.mark.parametrize("source", ["systematic term", "model"])
@pytest.mark.parametrize("limit", [0.02, 0.06, 0.075])
def test_a_common_offset_is_rayleigh_for_every_statistic(exact, shifting, source, limit):
    s, terms = (shifting(), ()) if source == "model" else (exact, SYSTEMATIC)
    reqs = [Requirement(name, name, limit) for name in STATISTICS]
    n = 4000
    for m in margins_of(s, reqs, terms=terms, grid=(5, 4), n_draws=n):
        if m.requirement.statistic in RADIAL:
            probability = 1 - np.exp(-(limit**2) / (2 * S**2))
        else:
            probability = stats.halfnorm(scale=S).cdf(limit)
        assert near(m.probability_met, n, probability)


def test_model_and_systematic_terms_add_in_quadrature(shifting):
    terms = [*SYSTEMATIC, UserTerm("other", "systematic", S, S)]
    [m] = margins_of(shifting(), [Requirement("r", "p95", 0.1)], terms=terms, n_draws=4000)
    assert near(m.probability_met, 4000, 1 - np.exp(-(0.1**2) / (2 * 3 * S**2)))


# On 201 points the percentiles fall on points: p50 is the 101st smallest of 201, and so on.
N = 201
RANKS = {"p50": 101, "p90": 181, "p95": 191, "p99": 199, "max": 201}


@pytest.mark.parametrize(
    "axis", ["", *(case_in_full(axis, instead="both axes are judged") for axis in ("u_", "v_"))]
)
def test_random_errors_have_the_distribution_of_order_statistics(exact, axis):
    point = stats.halfnorm(scale=S) if axis else stats.rayleigh(scale=S)
    n = 4000
    limits = {s: point.ppf(stats.beta(k, N + 1 - k).ppf(0.7)) for s, k in RANKS.items()}
    reqs = [Requirement(s, axis + s, limit) for s, limit in limits.items()]
    for m in margins_of(exact, reqs, terms=RANDOM, grid=(3, 67), n_draws=n):
        k = RANKS[m.requirement.name]
        at_least_k_below = stats.binom(N, point.cdf(m.requirement.limit)).sf(k - 1)
        assert at_least_k_below == pytest.approx(0.7)
        assert near(m.probability_met, n, 0.7)


def test_the_rms_of_random_errors_is_a_chi(exact):
    n = 4000
    for statistic, degrees in (("rms", 2 * N), ("u_rms", N)):
        limit = S * np.sqrt(stats.chi2(degrees).ppf(0.3) / N)
        [m] = margins_of(
            exact, [Requirement("r", statistic, limit)], terms=RANDOM, grid=(3, 67), n_draws=n
        )
        assert near(m.probability_met, n, 0.3)


def test_the_mean_of_random_errors_nears_that_of_rayleigh(exact):
    [m] = margins_of(exact, [Requirement("r", "mean", 1.0)], terms=RANDOM, grid=(40, 50))
    spread = S * np.sqrt((2 - np.pi / 2) / 2000)
    assert m.value == pytest.approx(S * np.sqrt(np.pi / 2), abs=5 * 1.2533 * spread / np.sqrt(2000))
    low, high = m.interval
    assert high - low == pytest.approx(2 * 1.96 * spread, rel=0.15)


def test_correlation_over_the_field_counts(shifting, exact):
    """The same sigma at each point: shared it meets a limit on the maximum far more often."""
    req = [Requirement("r", "max", 0.08)]
    [shared] = margins_of(shifting(), req)
    [independent] = margins_of(exact, req, terms=RANDOM)
    assert shared.probability_met > 0.95 > 0.1 > independent.probability_met


# -- the margin ------------------------------------------------------------------------------------


def test_value_interval_and_margin_of_a_rayleigh_error(exact):
    n = 20000
    [m] = margins_of(
        exact, [Requirement("r", "p68", 0.1)], terms=SYSTEMATIC, grid=(2, 2), n_draws=n
    )
    r = stats.rayleigh(scale=S)
    for value, p in (
        (m.value, 0.5), (m.interval[0], 0.025), (m.interval[1], 0.975), (0.1 - m.margin, 0.95),
    ):  # fmt: skip
        error = np.sqrt(p * (1 - p) / n) / r.pdf(r.ppf(p))
        assert value == pytest.approx(r.ppf(p), abs=5 * error)
    assert m.draws.shape == (n,) and m.unit == "pix"


@pytest.mark.parametrize("probability", [0.5, 0.683, 0.9, 0.95, 0.99])
def test_the_margin_is_positive_where_the_fraction_is_enough(exact, probability):
    options = dict(terms=SYSTEMATIC, grid=(2, 2), n_draws=1000, adaptive=False)
    [m] = margins_of(exact, [Requirement("r", "rms", 1.0)], **options)
    k = round(1000 * probability)
    limits = np.sort(m.draws)[k - 8 : k + 8]  # the hardest limits: equal to a draw
    reqs = [Requirement("r", "rms", limit, probability=probability) for limit in limits]
    margins = margins_of(exact, reqs, **options)
    assert [m.margin >= 0 for m in margins] == [False] * 7 + [True] * 9
    for m in margins:
        assert (m.margin >= 0) == (m.probability_met >= probability)


def test_limits_in_other_units_judge_the_same_thing(shifting):
    reqs = [Requirement("r", "p95", 0.07), Requirement("r", "p95", 3.5, "mas")]
    pix, mas = margins_of(shifting(), reqs, pixel_scale=50.0)
    assert pix.probability_met == mas.probability_met and mas.unit == "mas"
    for name in ("value", "margin"):
        assert getattr(mas, name) == pytest.approx(50 * getattr(pix, name), rel=1e-10)
    np.testing.assert_allclose(mas.interval, 50 * np.array(pix.interval), rtol=1e-12)


def test_angular_limits_need_a_scale_where_u_and_v_are_pixels(exact):
    with pytest.raises(InputError, match=r"requirement 'north'.*give detector\.scale_mas"):
        margins_of(exact, [Requirement("north", "max", 5.0, "mas")])


# -- the verdict -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("limit", "verdict"),
    [(0.2, "met"), (0.0025, "missed"), (0.05, "not shown")],
)
def test_verdicts_of_a_rayleigh_error(exact, limit, verdict):
    [m] = margins_of(exact, [Requirement("r", "p95", limit)], terms=SYSTEMATIC, grid=(3, 3))
    assert m.verdict == verdict and "0.95" in m.reason
    assert m.n_effective == 2000


def rayleigh_limit(probability):
    """Limit that the radial size of an offset of S on each axis meets with a probability."""
    return S * np.sqrt(-2 * np.log1p(-probability))


@pytest.mark.parametrize(
    ("probability", "verdict"),
    [(0.94, "not shown"), (0.949, "not shown"), (0.951, "met"), (0.96, "met"), (0.04, "missed"),
     (0.06, "not shown")],
)  # fmt: skip
def test_words_are_right_near_the_probabilities_that_decide(exact, probability, verdict, full):
    """By the closed form of a Rayleigh error: at most one seed in a hundred has another word."""
    n = 100 if full else 4
    words = [
        margins_of(
            exact, [Requirement("r", "rms", rayleigh_limit(probability))],
            seed=seed, terms=SYSTEMATIC, grid=(2, 2), n_draws=2000,
        )[0].verdict
        for seed in range(n)
    ]  # fmt: skip
    assert n - words.count(verdict) <= stats.binom(n, 0.01).ppf(0.999)


def test_draws_are_added_near_the_limit_only(exact):
    """Those that decide do not depend on which other requirements there are, nor on the run."""
    far, near_ = (Requirement("r", "rms", rayleigh_limit(p)) for p in (0.99, 0.952))
    options = dict(terms=SYSTEMATIC, grid=(2, 2), n_draws=1000)
    few, many = margins_of(exact, [far, near_], **options)
    assert few.n_effective == 1000 and many.n_effective > 10_000
    assert len(many.draws) == 1000 and many.verdict == "met"
    assert many.mc_error < 0.0022
    [alone] = margins_of(exact, [near_], **options)
    assert alone.probability_met == many.probability_met
    [fixed] = margins_of(exact, [near_], adaptive=False, **options)
    assert fixed.n_effective == 1000
    doubt = Check("Fit", "Residuals", sentence="structure is left", doubt=EITHER)
    [doubted] = margins_of(exact, [near_], checks=[doubt], **options)
    assert doubted.n_effective == 1000  # they would not change the word


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_a_finite_set_of_draws_is_worth_what_it_decides(rng, share):
    """The scatter of a probability over sets, one of two errors from a set of 200 draws.

    Errors a x + b y are within a limit: x is drawn anew, y is one of a set.
    """
    a, b, n, m, repeats = np.sqrt(1 - share), np.sqrt(share), 4000, 200, 400
    fractions, worth = [], []
    for _ in range(repeats):
        of_set, rows = rng.standard_normal(m), np.arange(n) % m
        tally = Tally(1.5)
        for _batch in range(2):
            values = np.abs(a * rng.standard_normal(n) + b * of_set[rows])
            tally.add(values, (Pool(rows, m),))
        fractions.append(tally.fraction)
        worth.append(tally.effective()[0])
    p = stats.norm.cdf(1.5) - stats.norm.cdf(-1.5)
    n_true = p * (1 - p) / np.var(fractions)
    # never worth more than they are, but for the chance of the variance of 400 fractions
    assert np.mean(worth) < n_true * (1 + 4 * np.sqrt(2 / repeats))
    assert np.mean(worth) > 0.5 * n_true
    if share == 1.0:
        assert np.mean(worth) == pytest.approx(m, rel=0.05)


def test_draws_of_a_sampler_that_are_used_again_are_not_new_ones(rng):
    """Sets that are renewed add up; a set whose draws are not told apart counts as decisive."""
    rows, n = np.arange(1000) % 100, 1000
    same, renewed, unknown = Tally(1.0), Tally(1.0), Tally(1.0)
    for _batch in range(4):
        values = np.abs(rng.standard_normal(100))[rows]
        renewed.add(values, (Pool(rows, 100, renewed=True),))
        unknown.add(values, (Pool(None, 100),))
    values = np.abs(rng.standard_normal(100))[rows]
    for _batch in range(4):
        same.add(values, (Pool(rows, 100),))
    assert renewed.effective()[0] == pytest.approx(400, rel=0.15)
    for tally in (same, unknown):
        assert tally.effective()[0] == pytest.approx(1 / (1 / (4 * n) + 1 / 100), rel=1e-6)


@pytest.mark.parametrize(("fraction", "n"), [(0.0, 50), (0.94, 50), (0.5, 400), (1.0, 400)])
def test_the_interval_is_the_exact_binomial_one(fraction, n):
    theirs = stats.binomtest(round(fraction * n), n).proportion_ci(0.99, method="exact")
    np.testing.assert_allclose(clopper_pearson(fraction, n, 0.99), theirs, rtol=1e-9, atol=1e-12)


def test_the_counting_error_is_that_of_a_count(exact):
    req = [Requirement("r", "rms", S)]
    [m] = margins_of(exact, req, terms=SYSTEMATIC, grid=(2, 2))
    p = m.probability_met
    assert m.mc_error == pytest.approx(np.sqrt(p * (1 - p) / 2000), rel=0.01)
    [sure] = margins_of(exact, [Requirement("r", "rms", 1.0)], terms=SYSTEMATIC, grid=(2, 2))
    assert sure.probability_met == 1 and 0 < sure.mc_error < 1 / 2000


def test_a_posterior_that_is_not_converged_leaves_everything_undecided(shifting):
    s = shifting(converged=False, reasons=("R-hat of u_0_0 is 1.3", "ESS is 20"))
    reqs = [Requirement("easy", "rms", 5.0), Requirement("hard", "rms", 1e-6)]
    for m in margins_of(s, reqs):
        assert m.verdict == "undecided"
        assert m.reason.startswith(
            "the posterior is not converged: R-hat of u_0_0 is 1.3; ESS is 20; the stated errors"
        )
    assert [m.verdict for m in margins_of(shifting(), reqs)] == ["met", "missed"]


def test_what_is_missed_is_missed_for_sure_where_errors_can_only_be_larger(shifting):
    reqs = [Requirement("easy", "rms", 5.0), Requirement("hard", "rms", 1e-6)]
    for doubt, verdicts in ((EITHER, ["undecided"] * 2), (LARGER, ["undecided", "missed"])):
        checks = [Check("Fit", "Residuals", sentence="structure is left", doubt=doubt)]
        found = margins_of(shifting(), reqs, checks=checks)
        assert [m.verdict for m in found] == verdicts
        for m in found:
            if m.verdict == "undecided":
                assert m.reason.startswith("structure is left; the stated errors alone would")
        assert all(m.remedy is None for m in found)
    # draws that are not to be trusted decide nothing, in either direction
    checks = [Check("Fit", "Residuals", sentence="structure is left", doubt=LARGER)]
    for m in margins_of(shifting(converged=False), reqs, checks=checks):
        assert m.verdict == "undecided"


@pytest.mark.parametrize("which", ["ess_bulk_min", "ess_tail_min"])
def test_few_effective_samples_decide_nothing_however_many_draws(shifting, which):
    """All draws meet the limit; with n_eff of them the lower end is 0.005^(1 / n_eff)."""
    req = [Requirement("r", "rms", 5.0)]
    [good] = margins_of(shifting(ess_bulk_min=400.0), req)
    [poor] = margins_of(shifting(**{which: 60.0}), req)
    assert good.probability_met == poor.probability_met == 1
    assert (good.verdict, poor.verdict) == ("met", "not shown")
    # four times as many draws were made in vain
    assert poor.n_effective == pytest.approx(1 / (1 / 60 + 1 / 8000))
    assert poor.n_effective < 60 and 0.005 ** (1 / poor.n_effective) < 0.95
    assert "60 effective draws" in poor.reason and "more draws" in poor.reason
    [lost] = margins_of(shifting(**{which: float("nan")}), req)
    assert lost.n_effective == 1 and lost.verdict == "not shown"


# -- epochs, blocks, seeds, refusals ---------------------------------------------------------------


def test_each_requirement_is_judged_at_its_own_epoch(rich):
    """The drift's error grows away from the reference date of 2004.5."""
    reqs = [
        Requirement("near", "rms", 1.0, epoch=2004.5),
        Requirement("default", "rms", 1.0),
        Requirement("far", "rms", 1.0, epoch=1950.0),
    ]
    near_, default, far = margins_of(rich, reqs, epoch=2004.5, n_draws=300, chip=2)
    assert (near_.epoch, default.epoch, far.epoch) == (2004.5, 2004.5, 1950.0)
    np.testing.assert_array_equal(near_.draws, default.draws)
    assert far.value > 3 * near_.value
    with pytest.raises(InputError, match="requirement 'default': the model depends on time"):
        margins_of(rich, reqs)


def test_blocks_of_draws_do_not_change_the_margins(shifting):
    req = [Requirement("r", "p90", 0.1)]
    options = dict(terms=[*SYSTEMATIC, *RANDOM], grid=(5, 5), n_draws=200)
    [whole] = margins_of(shifting(), req, **options)
    [cut] = margins_of(shifting(), req, block=75, **options)
    np.testing.assert_allclose(cut.draws, whole.draws, rtol=1e-12)
    [other] = margins_of(shifting(), req, seed=2, **options)
    assert (other.draws != whole.draws).all()


def test_nothing_asked_nothing_answered(exact):
    assert margins_of(exact, []) == ()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(statistic="rsm"), "unknown statistic 'rsm'; use 'rms' if that is meant"),
        (dict(limit=0.0), "limit is 0.0"),
        (dict(limit=float("nan")), "limit is nan"),
        (dict(probability=95), "probability is 95"),
        (dict(probability=1.0), "probability is 1.0"),
        (dict(unit="px"), "unknown unit 'px'"),
    ],
)
def test_bad_requirements_are_refused_by_name(change, message):
    with pytest.raises(InputError, match=f"requirement 'north': .*{message}"):
        Requirement(**(dict(name="north", statistic="p95", limit=0.1) | change))


def test_memory_does_not_grow_with_draws_times_points(shifting):
    """129 x 129 points and 1000 draws of two axes would be 266 MB at once."""
    options = dict(terms=RANDOM, grid=(129, 129), n_draws=1000)
    tracemalloc.start()
    try:
        margins_of(shifting(), [Requirement("r", "max", 1.0)], **options)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 60e6


def catalogue(name: str, sigma: float) -> UserTerm:
    return UserTerm(name, "systematic", sigma, sigma, "pix", varies=True)


def test_two_terms_that_vary_are_two_fields(exact):
    """In quadrature, as one of their common size: limits between the two decide alike."""
    limits = [Requirement(f"{limit}", "rms", limit) for limit in (0.012, 0.016, 0.02, 0.024)]
    grid = (9, 7)
    one = margins_of(exact, limits, terms=[catalogue("a", 0.01 * np.sqrt(2))], grid=grid)
    two = margins_of(exact, limits, terms=[catalogue("a", 0.01), catalogue("b", 0.01)], grid=grid)
    for x, y in zip(one, two, strict=True):
        assert x.value == pytest.approx(y.value, rel=0.06)


def test_a_catalogue_that_varies_is_judged_by_its_worst_form(exact):
    """The maximum of independent errors and of a field that grows outwards exceeds an offset."""
    limit = [Requirement("a", "max", 0.03)]
    still = margins_of(exact, limit, terms=[replace(catalogue("a", 0.01), varies=False)])
    (moving,) = margins_of(exact, limit, terms=[catalogue("a", 0.01)])
    assert still[0].verdict == "met"
    assert moving.probability_met < still[0].probability_met and moving.verdict != "met"
    doubt = Check("Fit", "Residuals", sentence="the residuals go with magnitude", doubt=LARGER)
    (doubted,) = margins_of(exact, limit, terms=[catalogue("a", 0.01)], checks=[doubt])
    assert doubt.sentence in doubted.reason and "varies over the field" in doubted.reason


@dataclass(frozen=True)
class OfTwoCauses(UserTerm):
    """An offset that is as large as another one if it has its other cause."""

    other: UserTerm | None = None

    @property
    def alternative(self) -> UserTerm | None:
        return self.other


@pytest.mark.parametrize(("of_detector", "of_catalogue"), [(0.005, 0.02), (0.02, 0.005)])
def test_an_error_of_unknown_cause_is_judged_by_both(exact, of_detector, of_catalogue):
    """A limit between the two is neither met nor missed; any other one is as with one cause."""
    limits = [Requirement(f"{limit}", "max", limit) for limit in (1e-4, 0.015, 0.1)]
    other = UserTerm("structure", "systematic", of_catalogue, of_catalogue)
    term = OfTwoCauses("structure", "systematic", of_detector, of_detector, other=other)
    smaller = UserTerm("structure", "systematic", 0.005, 0.005)
    verdicts = [m.verdict for m in margins_of(exact, limits, terms=[term])]
    assert verdicts == ["missed", "not shown", "met"]
    (alone,) = margins_of(exact, limits[1:2], terms=[smaller])
    assert alone.verdict == "met"
    between = margins_of(exact, limits[1:2], terms=[term])[0]
    assert "detector's or the catalogue's" in between.reason
    assert between.probability_met < alone.probability_met
    doubt = Check("Fit", "Residuals", sentence="the residuals go with magnitude", doubt=LARGER)
    (doubted,) = margins_of(exact, limits[1:2], terms=[term], checks=[doubt])
    assert doubted.verdict == "undecided" and doubt.sentence in doubted.reason


@pytest.mark.parametrize(("of_detector", "of_catalogue"), [(0.001, 0.01), (0.01, 0.001)])
def test_unknown_cause_and_unknown_extent_are_combined(exact, of_detector, of_catalogue):
    """A verdict holds for each cause of one error with each treatment of another one.

    The limit is met if the larger error is absent or the other one is an offset, not with both.
    """
    limit, grid, size = [Requirement("a", "max", 0.05)], (8, 8), 0.01
    varying = catalogue("Gaia DR3", size)
    other = UserTerm("structure", "systematic", of_catalogue, of_catalogue)
    term = OfTwoCauses("structure", "systematic", of_detector, of_detector, other=other)
    (margin,) = margins_of(exact, limit, terms=[term, varying], grid=grid)
    small = UserTerm("structure", "systematic", 0.001, 0.001)
    large = replace(small, sigma_u=size, sigma_v=size)
    for terms in ([small, varying], [large, replace(varying, varies=False)]):
        (met,) = margins_of(exact, limit, terms=terms, grid=grid)
        assert met.verdict == "met"
    rng = np.random.default_rng(1)
    drawn = size * (rng.standard_normal((20_000, 1, 2)) + rng.standard_normal((20_000, 64, 2)))
    independent = np.mean(np.linalg.norm(drawn, axis=2).max(axis=1) <= 0.05)
    assert margin.probability_met < independent + 5 * margin.mc_error
    assert margin.verdict == "not shown" and "varies over the field" in margin.reason
    # only one of the two causes is met by all treatments
    assert "detector's or the catalogue's" in margin.reason


@pytest.mark.parametrize(("stars", "small"), [(1500, True), (20, False)])
def test_few_stars_may_scatter_little_by_chance(stars, small):
    dof = 2 * stars - 20
    assert scatter_too_small(0.75 * dof, dof) == small
    assert not scatter_too_small(0.85 * dof, dof)
