"""The single functions of the Python interface find what a run finds, to the last bit."""

from __future__ import annotations

from contextlib import closing

import astropy.units as u
import numpy as np
import pytest

import bayesdist as bd
from bayesdist.app.config import parse_config
from bayesdist.app.config.results import BudgetBlock
from bayesdist.app.evaluating import margins_of_run
from bayesdist.app.stars import QUOTED
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess import Catalogue, UserTerm, check_requirements, error_budget
from bayesdist.assess.assessment import MISSING_TERMS
from bayesdist.diagnose.diagnostics import diagnose
from bayesdist.files.hdf5 import record_to_arrays
from tests.adversarial import KINDS
from tests.adversarial.measure import assessed
from tests.adversarial.python_face import carried
from tests.reduced import case_in_full

from .support import CENTRE, SIZE, after_stages, as_table, config_text, simulated

SEED = 2
# structure that is found, a drift in exposures with frames, a match circle that cuts the residuals,
# single exposures
STARS = {"smooth_270": 1200, "inside_drift": 900, "cut_at_2.4": 400, "breathing_new_exposure": 1600}
CASES = [
    "smooth_270",
    case_in_full("inside_drift", instead="tests/kinds/matches/test_calibrate has dates"),
    case_in_full("cut_at_2.4", instead="the circle is a check as others are"),
    case_in_full("breathing_new_exposure", instead="a drift has exposures, too"),
]
NEEDS = [
    bd.Requirement("loose", "p95", 0.5),
    bd.Requirement("near", "p95", 0.01, probability=0.6),
    bd.Requirement("tight", "max", 1e-4),
    bd.Requirement("pairs", "rms", 0.01, relative=True, separation=400.0),
]


@pytest.fixture(scope="module", params=CASES)
def both(request, tmp_path_factory):
    """A run and the steps of one truth."""
    folder = tmp_path_factory.mktemp("both")
    truth = KINDS[request.param].truth(0, STARS[request.param])
    with closing(assessed(truth, folder, SEED - 1)) as run:
        yield run, carried(truth, folder, SEED)


def assert_same(one, other):
    """Two records are the same to the last bit."""
    first, second = record_to_arrays(one), record_to_arrays(other)
    assert first.keys() == second.keys()
    for name, values in first.items():
        np.testing.assert_array_equal(values, second[name])


def test_diagnostics_are_those_of_a_run(both):
    run, steps = both
    np.testing.assert_array_equal(steps.posterior.theta, run.posterior.theta)
    assert_same(steps.diagnostics, run.diagnostics)
    again = diagnose(
        steps.posterior, steps.matches, fit=steps.fit, rng=np.random.default_rng([SEED, 2])
    )
    assert_same(again, run.diagnostics)


def test_budgets_are_those_of_a_run(both):
    run, steps = both
    assert steps.budget().rows() == run.evaluation.budget.rows()
    assert steps.budget().notes == ()


def test_verdicts_are_those_of_a_run(both):
    run, steps = both
    found, expected = steps.margins(NEEDS), margins_of_run(run, NEEDS)
    assert len({margin.verdict for margin in expected}) > 1
    for one, other in zip(found, expected, strict=True):
        assert_same(one, other)


def test_a_generator_in_place_of_the_seed_agrees_within_its_errors(both):
    _, steps = both
    (seeded,) = steps.margins(NEEDS[:1])
    (drawn,) = steps.margins(NEEDS[:1], rng=np.random.default_rng(20))
    assert drawn.value == pytest.approx(seeded.value, rel=0.1)
    assert (drawn.draws != seeded.draws).any()


def test_without_diagnostics_nothing_is_decided(both):
    _, steps = both
    for solution in (steps.posterior, steps.fit):
        options = steps.options | {"epoch": steps.truth.epoch, "rng": SEED}
        for margin in check_requirements(solution, NEEDS, **options):
            assert margin.verdict == "undecided"
            assert "the residuals were not examined; give diagnostics=" in margin.reason
        budget = error_budget(solution, **options)
        assert budget.notes == (MISSING_TERMS,) and MISSING_TERMS in repr(budget)


# -- terms of the user ----------------------------------------------------------------------------


def test_terms_quantities_and_magnitudes_are_those_of_a_run(tmp_path):
    """Rows of the budget in other units, one of them within the scatter of the residuals."""
    table = as_table(simulated(600, mag=np.linspace(12.0, 18.0, 600))[0])
    table.write(tmp_path / "stars.ecsv")
    catalogue = Catalogue("HSC PDR3", 0.0002 * u.arcsec, source="Aihara et al. 2022")
    seeing = {"name": "seeing", "kind": "random", "sigma_u": 0.1, "sigma_v": 0.2, "unit": "mas"}
    bright = {"name": "bright", "statistic": "p95", "limit": 3.0, "unit": "mas", "magnitude": 14.0}
    text = config_text(
        detector={"name": "A", "size": SIZE, "scale_mas": 50.0},
        budget=[catalogue.budget_row(), seeing | {"included_in_scatter": True}],
        requirement=[bright],
    )
    (tmp_path / "config.toml").write_text(text)
    config = parse_config(text, "config.toml")
    directory = RunDirectory.plan(tmp_path / "run", config, text, tmp_path)
    matches = bd.read_matches(tmp_path / "stars.ecsv")
    model = bd.build_model(matches, order=2, size=SIZE, reference_pixel=CENTRE, name="A")
    options = {"seed": config.sampler.seed, "target_ess": 100, "target_rhat": 1.05}
    posterior = bd.sample(bd.fit_linear(matches, model), matches, **options)
    stages = ("fit", "sample", "diagnose", "evaluate")
    with closing(after_stages(directory, *stages)) as run:
        assert run.errors == QUOTED
        options = {
            "diagnostics": diagnose(posterior, matches),
            "catalogue": catalogue,
            "terms": [UserTerm("seeing", "random", 0.1, 0.2, "mas", included_in_scatter=True)],
            "grid": (9, 7),
            "n_draws": 400,
            "pixel_scale": 0.05 * u.arcsec,
        }
        need = bd.Requirement("bright", "p95", 0.003 * u.arcsec, magnitude=14.0)
        assert (need.limit, need.unit) == (0.003, "arcsec")
        (margin,) = check_requirements(posterior, [need], **options)
        (expected,) = run.evaluation.margins
        assert error_budget(posterior, **options).rows() == run.evaluation.budget.rows()
        assert (margin.verdict, margin.reason) == (expected.verdict, expected.reason)
        assert margin.rests_on == expected.rests_on
        np.testing.assert_allclose(margin.draws, expected.draws / 1000, rtol=1e-12)


CATALOGUES = [
    Catalogue("Gaia DR3", sigma_mas=0.3),
    Catalogue("Gaia DR3", (0.3, 0.4), "mas", "Lindegren et al. 2021"),
    Catalogue("2MASS", 0.0, source="published: exact by definition"),
    Catalogue("our survey", 0.01, "pix"),
]


@pytest.mark.parametrize("catalogue", CATALOGUES, ids=str)
def test_a_catalogue_is_its_row_of_the_configuration(catalogue):
    config = parse_config(config_text(budget=[catalogue.budget_row()]), "config.toml")
    assert config.states_catalogue
    assert config.user_terms() == (catalogue.term(),)


@pytest.mark.parametrize(
    ("name", "sizes", "source", "stated"),
    [
        ("Gaia DR3", (0.0, 0.0), "given by the user", False),
        ("Gaia DR3", (0.0, 0.0), "exact in the simulation", True),
        ("Gaia DR3", (0.0, 0.1), "given by the user", True),
        ("camera", (0.1, 0.1), "given by the user", False),
        ("Gaia proper motions", (0.1, 0.1), "given by the user", False),
    ],
)
def test_a_term_states_the_catalogue_where_a_row_does(both, name, sizes, source, stated):
    _, steps = both
    row = {"name": name, "kind": "systematic", "sigma_u": sizes[0], "sigma_v": sizes[1]}
    block = BudgetBlock(**row, source=source)
    assert (block.stated and block.of_catalogue) == stated
    options = {"catalogue": None, "terms": [UserTerm(name, "systematic", *sizes, "mas", source)]}
    (margin,) = steps.margins(NEEDS[:1], **options, pixel_scale=1000.0)
    asks = "no error of the reference catalogue is stated" in margin.reason
    assert asks == (not stated)
    if asks:
        assert margin.verdict == "undecided"
