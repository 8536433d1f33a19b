"""Requirements on parts of the detector, on relative errors, through time; and what would help."""

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.distance import pdist

from bayesdist.assess import Requirement, UserTerm
from bayesdist.assess.domain import extent
from bayesdist.assess.model import error_model
from bayesdist.assess.requirements.margins import validity_period
from bayesdist.assess.terms.given import Centroids
from bayesdist.data import MagnitudeErrors
from bayesdist.diagnose.statistics import clopper_pearson
from bayesdist.errors import InputError
from bayesdist.model import Chip, DistortionModel, TimeDependence
from tests.reduced import case_in_full

from .by_draws import margins_by_draws

S = 0.03
SIZE = (101.0, 81.0)
CHIP = Chip(1, "A", SIZE, (51.0, 41.0))
FLAT = DistortionModel(1, (CHIP,))
EDGE = 50.0 / 50.5  # scaled position of the outermost pixels: the basis spans their outer edges
DRIFTING = DistortionModel(
    1, (CHIP,), time=TimeDependence((("u", 1, 0),), (2010.0, 2015.0), (2014.0,))
)


def margin_of(solution, requirement, seed=1, **options):
    options = {"n_draws": 4000, "grid": (21, 17)} | options
    [m] = margins_by_draws(solution, [requirement], rng=np.random.default_rng(seed), **options)
    return m


def with_sigma(solution_of, model, **sigmas):
    cov = np.zeros((model.n_params,) * 2)
    for name, sigma in sigmas.items():
        k = model.names.index(name.replace("__", "."))
        cov[k, k] = sigma**2
    return solution_of(model, cov=cov)


def near(counted, n, probability):
    return abs(counted - probability) < 5 * np.sqrt(probability * (1 - probability) / n) + 1e-12


# -- where -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("region", "reach"),
    [
        ("whole", 1.0),
        ("inner 50 %", 0.5),
        ("lower left", 1.0),
        (((36.0, 1.0), (66.0, 1.0), (66.0, 81.0), (36.0, 81.0)), 0.3),
    ],
)
def test_an_error_of_the_scale_is_as_large_as_the_region_is_wide(solution_of, region, reach):
    """Error S z X at scaled position X: its maximum over a region is S |z| times its reach."""
    solution = with_sigma(solution_of, FLAT, u_1_0=S)
    limit = 0.7 * S
    m = margin_of(solution, Requirement("r", "max", limit, region=region))
    # the grid of 21 points has steps of 0.1, and the polygon ends on the steps +-0.3
    edge = reach if isinstance(region, str) else 0.3
    expected = stats.halfnorm(scale=S * EDGE * edge).cdf(limit)
    if not isinstance(region, str):
        # of points exactly on a polygon's side one side is in and the other out
        assert m.worst.x in (36.0, 66.0)
    assert near(m.probability_met, 4000, expected)
    assert abs(m.worst.x - 51.0) == pytest.approx(50 * edge)
    assert m.worst.rms == pytest.approx(S * EDGE * edge, rel=5 / np.sqrt(2 * 4000))


def test_a_region_without_points_of_the_grid_is_refused(solution_of):
    solution = with_sigma(solution_of, FLAT, u_1_0=S)
    tiny = Requirement("r", "max", 1.0, region=((2.0, 2.0), (3.0, 2.0), (3.0, 3.0)))
    with pytest.raises(InputError, match="requirement 'r', region: the region holds 0 points"):
        margin_of(solution, tiny)


def test_the_percent_is_that_of_the_limit(solution_of):
    m = margin_of(with_sigma(solution_of, FLAT, u_1_0=S), Requirement("r", "max", 0.5))
    assert m.percent == pytest.approx(100 * m.margin / 0.5)


# -- between two positions -------------------------------------------------------------------------


def test_a_common_offset_is_no_relative_error(solution_of):
    solution = with_sigma(solution_of, FLAT, u_0_0=S)
    terms = [UserTerm("offset", "systematic", S, S)]
    m = margin_of(solution, Requirement("r", "max", 1e-6, relative=True), terms=terms)
    assert m.probability_met == 1.0
    assert margin_of(solution, Requirement("r", "max", 1e-6), terms=terms).probability_met == 0.0


@pytest.mark.parametrize("statistic", ["max", case_in_full("u_max", instead="max is judged")])
def test_the_largest_relative_error_of_a_scale_is_that_from_edge_to_edge(solution_of, statistic):
    solution = with_sigma(solution_of, FLAT, u_1_0=S)
    n = 1500
    m = margin_of(solution, Requirement("r", statistic, 1.5 * S, relative=True), n_draws=n)
    assert near(m.probability_met, n, stats.halfnorm(scale=2 * S * EDGE).cdf(1.5 * S))
    near_by = Requirement("r", statistic, 0.2 * S, relative=True, separation=10.0)
    m = margin_of(solution, near_by, n_draws=n)
    assert near(m.probability_met, n, stats.halfnorm(scale=0.2 * S * EDGE).cdf(0.2 * S))


def test_relative_random_errors_are_those_of_two_stars(solution_of):
    """The rms over pairs of the differences of independent errors is sqrt(2) times the error."""
    terms = [UserTerm("centroids", "random", S, S)]
    exact = solution_of(FLAT)
    m = margin_of(exact, Requirement("r", "rms", 1.0, relative=True), terms=terms)
    assert m.value == pytest.approx(2 * S, rel=0.01)
    assert margin_of(exact, Requirement("r", "rms", 1.0), terms=terms).value == pytest.approx(
        np.sqrt(2) * S, rel=0.01
    )


def test_the_extent_of_errors_is_their_largest_distance():
    error = np.random.default_rng(1).standard_normal((50, 40, 2))
    largest = [pdist(e).max() for e in error]
    found = extent("max", error)
    assert (found <= largest).all()
    assert found == pytest.approx(largest, rel=4e-4)
    assert extent("v_max", error) == pytest.approx([pdist(e[:, 1:]).max() for e in error])


def test_no_pair_is_as_near_as_asked(solution_of):
    with pytest.raises(InputError, match="no two points of the grid"):
        margin_of(
            with_sigma(solution_of, FLAT, u_1_0=S),
            Requirement("r", "max", 1.0, relative=True, separation=2.0),
        )


# -- when ------------------------------------------------------------------------------------------


def test_a_range_of_epochs_is_judged_at_its_worst(solution_of):
    """The rate's error grows with the distance from the reference date of its segment."""
    names = DRIFTING.names
    [first, second] = [n for n in names if n.startswith("tdd.u_1_0.rate")]
    solution = with_sigma(solution_of, DRIFTING, **{first: S, second: 1e-12})
    limit = 3.0 * S * EDGE
    m = margin_of(solution, Requirement("r", "max", limit, epochs=(2008.0, 2016.0)))
    # just before the break the first segment is four years from its reference date
    assert m.epoch == pytest.approx(2014.0, abs=1e-6)
    assert near(m.probability_met, 4000, stats.halfnorm(scale=4 * S * EDGE).cdf(limit))


def test_epochs_are_refused_where_nothing_depends_on_time(solution_of):
    with pytest.raises(InputError, match="does not depend on time"):
        margin_of(solution_of(FLAT), Requirement("r", "max", 1.0, epochs=(2010.0, 2012.0)))


def drifting_errors(solution_of, sigma, n_draws=4000):
    [rate, _] = [n for n in DRIFTING.names if n.startswith("tdd.u_1_0.rate")]
    solution = with_sigma(solution_of, DRIFTING, **{rate: sigma})
    return error_model(solution).drawn(n_draws, np.random.default_rng(2))


def test_the_validity_period_ends_where_a_growing_error_passes_the_limit(solution_of):
    model = DistortionModel(1, (CHIP,), time=TimeDependence((("u", 1, 0),), (2010.0,)))
    [rate] = [n for n in model.names if n.startswith("tdd.u_1_0.rate")]
    solution = with_sigma(solution_of, model, **{rate: S / EDGE})
    errors = error_model(solution).drawn(4000, np.random.default_rng(2))
    r = Requirement("edge", "max", 0.2, probability=0.9)
    found = validity_period(errors, r, np.arange(2010.5, 2020.0, 0.25), grid=(5, 5))
    # sigma at the edge is S years; met with probability 0.9 where 1.645 sigma is the limit
    date = 2010.0 + 0.2 / (S * stats.norm.ppf(0.95))
    early, late = found.interval
    assert early < date < late
    assert late - early < 1.0
    assert early <= found.date <= late
    assert "recalibrate before" in found.sentence
    assert (np.diff(found.probability) <= 0).all()  # one set of draws: the curve has no noise
    k = int(np.argmin(np.abs(found.epoch - 2014.0)))
    assert near(found.probability[k], 4000, stats.halfnorm(scale=4 * S).cdf(0.2))
    assert (found.low[k], found.high[k]) == clopper_pearson(found.probability[k], 4000, 0.95)


def test_a_validity_period_may_lie_beyond_and_may_have_passed(solution_of):
    errors = drifting_errors(solution_of, 1e-9)
    r = Requirement("edge", "max", 0.2)
    assert validity_period(errors, r, [2015.0, 2030.0]).date is None
    assert "until 2030.0" in validity_period(errors, r, [2015.0, 2030.0]).sentence
    missed = validity_period(errors, Requirement("edge", "max", 1e-12), [2012.0, 2013.0])
    assert missed.date == 2012.0


# -- of which star ---------------------------------------------------------------------------------


def test_the_centroid_of_a_star_counts_where_a_magnitude_is_named(solution_of):
    one = np.array([1])
    errors = MagnitudeErrors(np.array([-12.0]), S * one, S * one, one, S * one, S * one)
    m = margin_of(
        solution_of(FLAT), Requirement("r", "rms", 1.0, magnitude=-12.0), terms=[Centroids(errors)]
    )
    assert m.value == pytest.approx(np.sqrt(2) * S, rel=0.01)
    with pytest.raises(InputError, match="magnitude -12 is not known"):
        margin_of(solution_of(FLAT), Requirement("r", "rms", 1.0, magnitude=-12.0))


# -- what would have to shrink ---------------------------------------------------------------------


def test_the_remedy_is_the_size_at_which_the_limit_is_met(solution_of):
    """A Rayleigh error of two terms: the larger may keep what the smaller one leaves it."""
    terms = [UserTerm("large", "systematic", S, S), UserTerm("small", "systematic", S / 3, S / 3)]
    limit = 0.05
    m = margin_of(solution_of(FLAT), Requirement("r", "p95", limit), terms=terms)
    assert m.verdict == "not shown"
    assert (m.remedy.term, m.remedy.enough) == ("large", True)
    allowed = limit / stats.rayleigh.ppf(0.95)  # sigma of an axis
    needed = np.sqrt(2 * (allowed**2 - (S / 3) ** 2))
    assert m.remedy.now == pytest.approx(np.sqrt(2) * S)
    assert m.remedy.needed == pytest.approx(needed, rel=0.06)  # of 1000 draws


def test_a_part_of_the_model_can_be_the_remedy(solution_of):
    solution = with_sigma(solution_of, FLAT, u_0_0=S, v_0_0=S)
    terms = [UserTerm("small", "random", 1e-6, 1e-6)]
    m = margin_of(solution, Requirement("r", "max", 0.03), terms=terms)
    assert m.remedy.term == "coefficients"
    assert m.remedy.factor == pytest.approx(0.03 / stats.rayleigh.ppf(0.95) / S, rel=0.06)
    assert "fell from" in m.remedy.sentence


def test_where_no_term_suffices_the_largest_is_named(solution_of):
    terms = [UserTerm(n, "systematic", S, S) for n in ("one", "two")]
    m = margin_of(solution_of(FLAT), Requirement("r", "p95", S), terms=terms)
    assert not m.remedy.enough
    assert "no term can do it alone" in m.remedy.sentence
    assert margin_of(solution_of(FLAT), Requirement("r", "p95", 1.0), terms=terms).remedy is None


# -- what is refused -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"epoch": 2010.0, "epochs": (2010.0, 2011.0)}, "an epoch and a range"),
        ({"epochs": (2011.0, 2010.0)}, "range of epochs"),
        ({"separation": 10.0}, "error is that of one"),
        ({"separation": -1.0, "relative": True}, "separation is -1"),
        ({"region": "corner"}, "no region 'corner'"),
    ],
)
def test_requirements_at_odds_with_themselves_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        Requirement("r", "max", 1.0, **options)


def test_a_polygon_names_its_chip(solution_of):
    model = DistortionModel(1, (CHIP, Chip(2, "B", SIZE, (51.0, 41.0))))
    triangle = ((1.0, 1.0), (90.0, 1.0), (1.0, 70.0))
    with pytest.raises(InputError, match="polygon lies on one chip"):
        margin_of(solution_of(model), Requirement("r", "max", 1.0, region=triangle))
    margin_of(solution_of(model), Requirement("r", "max", 1.0, region=triangle, chip=2))
