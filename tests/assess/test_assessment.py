"""Budgets and verdicts of single functions: what they refuse, lack and show."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import astropy.units as u
import numpy as np
import pytest

from bayesdist.assess import (
    Catalogue,
    Requirement,
    UserTerm,
    check_requirements,
    error_budget,
    uncertainty_map,
)
from bayesdist.diagnose.diagnostics import diagnose
from bayesdist.errors import InputError
from bayesdist.infer import build_model, fit_linear, sample
from bayesdist.model import Chip, DistortionModel
from bayesdist.utils.random import assessment_rng
from bayesdist.utils.text import rounded
from tests.app.support import CENTRE, SIZE, simulated

S = 0.03
EASY = Requirement("easy", "rms", 5.0)
HARD = Requirement("hard", "rms", 1e-6)
GAIA = Catalogue("Gaia DR3", 0.001, "pix")


@pytest.fixture(scope="module")
def shifting(solution_of):
    """Two chips whose only error is a common shift of each, S on each axis of the first."""
    chips = tuple(Chip(k, f"C{k}", (100.0, 80.0), (50.0, 40.0)) for k in (1, 2))
    model = DistortionModel(1, chips)
    cov = np.zeros((12, 12))
    cov[0, 0] = cov[3, 3] = S**2
    return solution_of(model, cov=cov)


@pytest.fixture(scope="module")
def steps():
    """Matches, fit, posterior and diagnostics of a few stars."""
    matches, _ = simulated(300)
    fit = fit_linear(matches, build_model(matches, order=2, size=SIZE, reference_pixel=CENTRE))
    posterior = sample(fit, matches, target_ess=100, target_rhat=1.05)
    return matches, fit, posterior, diagnose(posterior, matches, fit=fit)


def said(error) -> str:
    """The message, which is one sentence that says what to do."""
    text = str(error.value)
    assert text.endswith(".") and "\n" not in text and "; " in text
    return text


# -- what is not known --------------------------------------------------------------------------


def test_nothing_is_decided_of_residuals_that_were_not_examined(shifting):
    """Neither what the stated errors alone would meet, nor what they would miss."""
    for margin, alone in zip(
        check_requirements(shifting, [EASY, HARD], catalogue=GAIA), ("meet", "miss"), strict=True
    ):
        assert margin.verdict == "undecided"
        assert margin.reason.startswith(
            "the residuals were not examined; give diagnostics=bd.diagnose(posterior, matches); "
            f"the stated errors alone would {alone} it"
        )


def test_a_budget_says_which_terms_are_missing(shifting):
    for solution_terms in ({"catalogue": GAIA}, {"terms": [GAIA.term()]}):
        budget = error_budget(shifting, n_draws=50, **solution_terms)
        (note,) = budget.notes
        assert note.startswith("measured terms are missing (structure")
        for shown in (repr(budget), str(budget), budget._repr_html_()):
            assert "measured terms are missing" in shown
        assert budget.to_table().meta["notes"] == [note]
    assert "no error of the reference catalogue" in error_budget(shifting, n_draws=50).notes[1]


def test_with_diagnostics_verdicts_are_given(steps):
    _, _, posterior, diagnostics = steps
    options = {"diagnostics": diagnostics, "n_draws": 2000, "grid": (9, 7)}
    easy, hard = check_requirements(posterior, [EASY, HARD], catalogue=GAIA, **options)
    assert (hard.verdict, easy.verdict) == ("missed", "met")
    easy, _ = check_requirements(posterior, [EASY, HARD], **options)
    assert easy.verdict == "undecided" and "reference catalogue is stated" in easy.reason
    budget = error_budget(posterior, catalogue=GAIA, **options)
    assert "unmodelled structure" in budget.names and budget.notes == ()


def test_the_default_field_is_that_of_all_chips(shifting):
    budget = error_budget(shifting, grid=(3, 2), n_draws=20_000)
    assert budget.domain.chips == (1, 2)
    first, second = budget.chips
    assert first.total.u == pytest.approx(S, rel=5 / np.sqrt(2 * 20_000))
    assert (second.total.u == 0).all()
    (alone,) = error_budget(shifting, grid=(3, 2), n_draws=20_000, chip=1).chips
    np.testing.assert_array_equal(alone.total.u, first.total.u)


# -- seeds ----------------------------------------------------------------------------------------


def test_a_seed_is_that_of_a_run_and_a_generator_is_itself(shifting):
    (one,) = check_requirements(shifting, [EASY], rng=7)
    (again,) = check_requirements(shifting, [EASY], rng=np.int64(7))
    (given,) = check_requirements(shifting, [EASY], rng=np.random.default_rng([7, 2]))
    (other,) = check_requirements(shifting, [EASY], rng=8)
    np.testing.assert_array_equal(one.draws, again.draws)
    np.testing.assert_array_equal(one.draws, given.draws)
    assert (one.draws != other.draws).any()
    rng = np.random.default_rng(1)
    assert assessment_rng(rng) is rng


# -- what is refused --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rng": -1}, "rng is -1"),
        ({"rng": "a"}, "rng is 'a'"),
        ({"exposure": "sngle"}, "unknown exposure 'sngle'; use 'single'"),
        (
            {"catalogue": "Gaia"},
            "catalogue: the catalogue is 'Gaia'; give an object, as in bd.Catalogue",
        ),
        ({"diagnostics": "none"}, "diagnostics: they are a str; give what bd.diagnose"),
        ({"chip": 9}, "9"),
        ({"n_draws": 1}, "the number of draws is 1"),
        ({"pixel_scale": 3 * u.s}, "pixel_scale is given in s"),
        ({"epoch": "soon"}, "epoch is 'soon'"),
        ({"terms": [UserTerm("a", "random", 1.0, 1.0, "mas")]}, "pixel scale"),
    ],
)
def test_what_is_refused(shifting, options, words):
    for ask in (
        lambda: error_budget(shifting, **options),
        lambda: check_requirements(shifting, [EASY], **options),
    ):
        with pytest.raises(InputError) as error:
            ask()
        assert words in said(error)


def test_diagnostics_belong_to_their_posterior(steps, shifting):
    matches, fit, _, diagnostics = steps
    with pytest.raises(InputError) as error:
        check_requirements(fit, [EASY], diagnostics=diagnostics)
    assert "of a posterior, but the solution is a LinearFit; give the posterior" in said(error)
    other = sample(
        fit_linear(matches, build_model(matches, order=1, size=SIZE)), matches, target_ess=50
    )
    with pytest.raises(InputError) as error:
        error_budget(other, diagnostics=diagnostics)
    assert "those of another solution" in said(error)


def test_diagnostics_of_other_stars_are_refused(steps):
    """As many stars of the same truth: nothing but their positions differs."""
    _, _, posterior, _ = steps
    others, _ = simulated(300, seed=2)
    with pytest.raises(InputError) as error:
        diagnose(posterior, others)
    assert "made from other stars" in said(error)
    fit = fit_linear(others, posterior.model)
    other = sample(fit, others, target_ess=100, target_rhat=1.05)
    with pytest.raises(InputError) as error:
        check_requirements(posterior, [EASY], diagnostics=diagnose(other, others, fit=fit))
    assert "those of another solution" in said(error)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (lambda m, f, p: {"posterior": f}, "a LinearFit has no posterior to examine"),
        (lambda m, f, p: {"matches": m.select(np.arange(200))}, "300 stars, and these are 200"),
        (lambda m, f, p: {"match_radius": 0.0}, "the match radius is 0 pix"),
        (lambda m, f, p: {"match_radius": 1 * u.mas}, "match_radius is given in mas"),
        (lambda m, f, p: {"rng": None}, "rng is None"),
        (
            lambda m, f, p: {"fit": fit_linear(m, build_model(m, order=1, size=SIZE))},
            "the fit and the posterior have different models",
        ),
    ],
)
def test_what_is_not_diagnosed(steps, given, words):
    matches, fit, posterior, _ = steps
    options = {"posterior": posterior, "matches": matches} | given(matches, fit, posterior)
    with pytest.raises(InputError) as error:
        diagnose(options.pop("posterior"), options.pop("matches"), **options)
    assert words in said(error)


@pytest.mark.parametrize(
    ("arguments", "options", "words"),
    [
        (("", 1.0), {}, "has the name ''"),
        (("  ", 1.0), {}, "has the name '  '"),
        ((None, 1.0), {}, "has the name None"),
        (
            ("Gaia",),
            {},
            "no published errors are known of a catalogue with this name, but of Gaia DR3",
        ),
        (("Gaia", 1.0), {"sigma_mas": 1.0}, "the size of its error is given twice"),
        (("Gaia", -1.0), {}, "its error is -1.0 mas; give a number of 0 or more"),
        (("Gaia", float("nan")), {}, "its error is nan mas"),
        (("Gaia", (1.0, -2.0)), {}, "its error is -2.0 mas"),
        (("Gaia", (1.0, 2.0, 3.0)), {}, "its error has 3 sizes"),
        (("Gaia", 1.0, "px"), {}, "unknown unit 'px'"),
        (("Gaia", 1.0 * u.s), {}, "sigma is given in s"),
        (("Gaia", (1.0 * u.mas, 1.0)), {}, "one sigma has a unit and the other has none"),
        (("Gaia", "small"), {}, "which is not a number"),
        (("Gaia", 0.0), {}, "its error is 0, and no source is given for that"),
        (("Gaia", 0.0), {"source": "given by the user"}, "no source is given for that"),
        (("Gaia proper motions", 1.0), {}, "the name is that of proper motions"),
    ],
)
def test_catalogues_that_are_refused(arguments, options, words):
    with pytest.raises(InputError) as error:
        Catalogue(*arguments, **options)
    assert words in said(error)


def test_sizes_of_catalogues_and_terms_may_have_units():
    assert Catalogue("Gaia", 0.3e-3 * u.arcsec).sigma == pytest.approx((0.3e-3, 0.3e-3))
    assert Catalogue("Gaia", 0.3e-3 * u.arcsec).unit == "arcsec"
    assert Catalogue("Gaia", [0.1, 0.2] * u.pix).budget_row() == {
        "name": "Gaia",
        "kind": "systematic",
        "sigma_u": 0.1,
        "sigma_v": 0.2,
        "unit": "pix",
    }
    assert Catalogue("Gaia", sigma_mas=0.3) == Catalogue("Gaia", 0.3, "mas")
    term = UserTerm("flat field", "random", 1 * u.uas, 2 * u.uas)
    assert term.unit == "mas" and (term.sigma_u, term.sigma_v) == pytest.approx((1e-3, 2e-3))
    assert not term.varies and UserTerm("Gaia DR3", "systematic", 1.0, 1.0).varies
    with pytest.raises(InputError, match="included_in_scatter applies only to random budget terms"):
        UserTerm("a", "systematic", 1.0, 1.0, included_in_scatter=True)


# -- what is shown --------------------------------------------------------------------------------


class Balanced(HTMLParser):
    """Counts rows and cells; tags are closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.tags: list[str] = []
        self.text = ""

    def handle_starttag(self, tag, attrs):
        self.stack.append(tag)
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        self.text += data


def parsed(html: str) -> Balanced:
    page = Balanced()
    page.feed(html)
    assert page.stack == []
    return page


def test_names_of_the_user_are_text_in_notebooks(shifting):
    bad = "<script>alert('reference')</script>"
    term = UserTerm(bad, "systematic", 0.01, 0.02, source="<b>me</b>")
    budget = error_budget(shifting, terms=[term], n_draws=50)
    page = parsed(budget._repr_html_())
    assert set(page.tags) == {"table", "caption", "tr", "th", "td", "p"} and bad in page.text
    assert page.tags.count("tr") == 4 and page.tags.count("td") == 3 * 7
    (margin,) = check_requirements(shifting, [Requirement(bad, "rms", 1.0)], n_draws=100)
    page = parsed(margin._repr_html_())
    assert set(page.tags) == {"p", "b"} and bad in page.text and page.tags.count("b") == 1


def test_representations_are_short_and_lead_with_what_matters(steps):
    _, _, posterior, diagnostics = steps
    options = {"diagnostics": diagnostics, "catalogue": GAIA, "grid": (9, 7), "n_draws": 500}
    budget = error_budget(posterior, **options)
    total = budget.rows()[-1]["radial"]
    assert repr(budget).startswith(f"ErrorBudget(total {total:.3g} pix radial rms at 63 positions")
    table = str(budget).splitlines()
    assert [line.split("  ")[0] for line in table[2:]] == [row["name"] for row in budget.rows()]
    (margin,) = check_requirements(posterior, [HARD], **options)
    assert repr(margin).startswith(
        f"Margin(hard: missed: rms {rounded(margin.value, np.ptp(margin.interval) / 4)} pix, "
    )
    least = 1.0 / margin.n_effective  # one draw, rounded up to its first digits
    bound = float(re.search(r"limit 1e-06 pix, P < ([\d.]+), 0.95 asked for: ", repr(margin))[1])
    assert least <= bound < least + 1e-3
    assert "array" not in repr(margin) and "\n" not in str(margin)
    found = uncertainty_map(posterior, grid=(5, 3))
    assert re.fullmatch(
        r"UncertaintyMap\(posterior, chip 1, 5 x 3 positions: at most [\d.]+ pix per axis, at "
        r"pixel \(\d+, \d+\)\)",
        repr(found),
    )
    assert f"{found.per_axis.max():.3g} pix" in repr(found)
    shown = repr(diagnostics)
    n_tests = len(diagnostics.score_tests)
    assert shown.startswith("Diagnostics of 300 stars: ") and f"{n_tests} tests" in shown
    assert "array" not in shown and len(shown) < 2000


def test_a_budget_is_a_table_with_units(steps):
    _, _, posterior, diagnostics = steps
    budget = error_budget(
        posterior, diagnostics=diagnostics, catalogue=GAIA, grid=(9, 7), n_draws=500
    )
    table, rows = budget.to_table(), budget.rows()
    assert list(table["name"]) == [row["name"] for row in rows]
    scale = u.pixel_scale(50 * u.mas / u.pix)
    np.testing.assert_allclose(
        table["radial"].to_value(u.mas, scale), [50 * row["radial"] for row in rows]
    )
    np.testing.assert_allclose(np.hypot(table["u"], table["v"]), table["radial"])
    for row, error in zip(rows, table["relative_error"], strict=True):
        if row["radial_error"] is None:
            assert np.isnan(error)
        else:
            assert error * row["radial"] == pytest.approx(row["radial_error"])
    assert table.meta["chips"] == [1]


def test_findings_are_in_the_representation_as_sentences():
    """Stars of order 2 under a straight line."""
    matches, _ = simulated(300)
    fit = fit_linear(matches, build_model(matches, order=1, size=SIZE))
    posterior = sample(fit, matches, target_ess=50, target_rhat=1.1)
    diagnostics = diagnose(posterior, matches)
    lines = repr(diagnostics).splitlines()
    assert re.search(r": \d+ of \d+ tests of the residuals found something", lines[0])
    assert any("structure that the model does not describe" in line for line in lines[1:])
