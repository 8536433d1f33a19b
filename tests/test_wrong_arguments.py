"""Arguments of the wrong type: one sentence with the argument, and no exception of Python."""

from __future__ import annotations

import astropy.units as u
import numpy as np
import pytest

import bayesdist as bd

CHIP = bd.Chip(1, "camera", (1000, 1000), (500.5, 500.5))
MODEL = bd.DistortionModel(1, (CHIP,), "pix")
WRONG = {
    "number": -3.5,
    "text": "x",
    "object": object(),
    "list": [1, 2],
    "mapping": {"a": 1},
    "nan": float("nan"),
    "seconds": 5 * u.s,
}
# values of `WRONG` that are right for an argument of `calibrate`
RIGHT = {"name": {"text"}, "size": {"list"}, "reference_pixel": {"list"}}
ARGUMENTS = (
    "order size chips reference_pixel scale_mas frames time sigma outliers catalogue terms "
    "requirements epoch exposure held_out seed name settings"
).split()


@pytest.fixture(scope="module")
def stars():
    rng = np.random.default_rng(1)
    return bd.simulate_matches(MODEL, [0, 500, 0, 0, 0, 500], 100, sigma=0.01, rng=rng)[0]


def refusal(function, **arguments):
    with pytest.raises(bd.InputError) as caught:
        function(**arguments)
    text = str(caught.value)
    assert caught.value.do and "\n" not in text
    return text


@pytest.mark.parametrize("kind", WRONG)
@pytest.mark.parametrize("name", ARGUMENTS)
def test_calibrate_names_the_argument(stars, name, kind):
    if kind in RIGHT.get(name, ()):
        pytest.skip("a right value")
    arguments = {"order": 1, "size": (1000, 1000), name: WRONG[kind]}
    text = refusal(bd.calibrate, matches=stars, **arguments)
    for words in ("detector.", "sampler.", "model.", "assess.", "[[", "--"):
        assert words not in text
    if name != "settings":  # where the key is named, or the value
        assert name.rstrip("s") in text


@pytest.mark.parametrize(
    ("arguments", "remedy"),
    [
        ({"size": 1000}, "as in size=(2048, 1024)"),
        ({"size": "1000x1000"}, "as in size=(2048, 1024)"),
        ({"size": (1000, 1000), "reference_pixel": 500}, "as in reference_pixel=("),
        ({"size": (1000, 1000), "sigma": np.full(100, 0.1)}, "as columns sigma_u and sigma_v"),
        ({"size": (1000, 1000), "sigma": 5 * u.mas}, "divide sigma by the size of a pixel"),
    ],
    ids=str,
)
def test_the_remedy_is_in_terms_of_python(stars, arguments, remedy):
    assert remedy in refusal(bd.calibrate, matches=stars, order=1, **arguments)


@pytest.mark.parametrize("kind", WRONG)
def test_matches_that_are_none(kind):
    refusal(bd.calibrate, matches=WRONG[kind], order=1, size=(1000, 1000))


@pytest.mark.parametrize(
    "settings",
    [{"data": 5}, {"sampler": "x"}, {5: {}}, {"sampler": {"max_steps": "x"}}, {"budget": [5]}],
    ids=str,
)
def test_sections_of_settings(stars, settings):
    text = refusal(bd.calibrate, matches=stars, order=1, size=(1000, 1000), settings=settings)
    assert "settings[" in text


def test_a_quantity_in_settings_is_no_number(stars):
    """Its unit would be lost."""
    settings = {"outliers": {"match_radius": 5 * u.arcsec}}
    text = refusal(bd.calibrate, matches=stars, order=1, size=(1000, 1000), settings=settings)
    assert "has a unit" in text


@pytest.mark.parametrize("kind", ["number", "text", "object", "list", "mapping"])
def test_objects_of_other_types(stars, kind):
    fit, wrong = bd.fit_linear(stars, MODEL), WRONG[kind]
    cases = [
        (bd.build_model, {"matches": wrong, "order": 1, "size": (1000, 1000)}, "matches"),
        (bd.fit_linear, {"matches": stars, "model": wrong}, "model"),
        (bd.fit_linear, {"matches": wrong, "model": MODEL}, "matches"),
        (bd.fit_linear, {"matches": stars, "model": MODEL, "rejection": wrong}, "rejection"),
        (bd.fit_by_magnitude, {"matches": wrong, "model": MODEL}, "matches"),
        (bd.sample, {"fit": wrong, "matches": stars}, "fit"),
        (bd.sample, {"fit": fit, "matches": wrong}, "matches"),
        (bd.sample, {"fit": fit, "matches": stars, "outliers": wrong}, "outliers"),
        (bd.memberships, {"posterior": wrong, "matches": stars}, "posterior"),
        (bd.save_posterior, {"posterior": wrong, "matches": None, "path": "x.nc"}, "posterior"),
    ]
    for function, arguments, name in cases:
        text = refusal(function, **arguments)
        assert text.startswith(f"{function.__name__}: {name} is a")
        assert ("Matches.from_table" in text) == (name == "matches")


@pytest.mark.parametrize("kind", ["number", "text", "object", "list", "mapping"])
def test_solutions_of_other_types(stars, kind):
    fit, wrong = bd.fit_linear(stars, MODEL), WRONG[kind]
    need = bd.Requirement("field", "p95", 0.1)
    for function, arguments in (
        (bd.error_budget, {}),
        (bd.uncertainty_map, {}),
        (bd.check_requirements, {"requirements": [need]}),
        (bd.residuals, {"matches": stars}),
    ):
        text = refusal(function, solution=wrong, **arguments)
        assert text.startswith(f"{function.__name__}: solution is a")
        assert text.endswith("give a Posterior or LinearFit.")
    assert "give a Posterior" in refusal(bd.Calibration.from_solution, solution=wrong)
    assert "not a requirement" in refusal(bd.check_requirements, solution=fit, requirements=wrong)
    assert "catalog is a" in refusal(bd.match_table, table=stars, catalog=wrong)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: bd.Chip(1, "a", 1000, (1, 1)), "size is 1000"),
        (lambda: bd.Chip(1, "a", "ab", (1, 1)), "size is 'ab'"),
        (lambda: bd.Chip(1, "a", (-1000, 1000), (1, 1)), "size is (-1000, 1000)"),
        (lambda: bd.Chip(1, "a", (9, 9, 9), (1, 1)), "size is (9, 9, 9)"),
        (lambda: bd.Chip(1, "a", (9, 9), (np.nan, 1)), "reference_pixel is"),
        (lambda: bd.Chip("a", "a", (9, 9), (1, 1)), "number is 'a'"),
        (lambda: bd.DistortionModel("2", (CHIP,), "pix"), "order is '2'"),
        (lambda: bd.DistortionModel(2, CHIP, "pix"), "chips is Chip"),
        (lambda: bd.DistortionModel(2, (CHIP,), "m"), "unknown unit 'm'"),
        (lambda: bd.TimeDependence("ab", (2000.0,)), "term 'a'"),
        (lambda: bd.TimeDependence((("u", 1, 0),), ("x",)), "epoch0 is ('x',)"),
        (lambda: bd.OutlierMixture("uniform", "2"), "'2' is not a length"),
        (lambda: bd.Rejection(-1), "clip_chi2 is -1"),
        (lambda: bd.Rejection("x"), "clip_chi2 is 'x'"),
        (lambda: bd.Requirement("a", "p95", 1, probability="high"), "probability is 'high'"),
        (lambda: bd.Requirement("a", "p95", 1, magnitude="bright"), "magnitude is 'bright'"),
        (lambda: bd.simulate_matches(MODEL, np.zeros(6), -1, rng=1), "number of matches is -1"),
        (lambda: bd.simulate_matches(MODEL, np.zeros(6), "9", rng=1), "number of matches is '9'"),
        (lambda: bd.simulate_matches(MODEL, np.zeros(6), 9, fraction=3, rng=1), "matches is 3"),
    ],
)
def test_objects_refuse_what_they_cannot_hold(make, words):
    assert words in refusal(make)


def test_one_requirement_needs_no_list(stars):
    fit, need = bd.fit_linear(stars, MODEL), bd.Requirement("field", "p95", 0.1)
    options = {"grid": (3, 3), "n_draws": 100}
    (one,) = bd.check_requirements(fit, need, **options)
    (other,) = bd.check_requirements(fit, [need], **options)
    assert (one.value, one.verdict) == (other.value, other.verdict)
    assert bd.Requirement("a", "p95", 1, magnitude=15 * u.mag).magnitude == 15.0
