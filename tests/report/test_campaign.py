"""What the report shows of a campaign: its numbers are those of the run's files."""

from __future__ import annotations

import base64
import re
from dataclasses import replace

import numpy as np
import pytest
from lxml import html as lxml_html

from bayesdist.app.parts import StoredLookupTables
from bayesdist.assess.solution import coefficient_table
from bayesdist.diagnose.checks import structure_checks
from bayesdist.diagnose.residuals.misfit import Misfit
from bayesdist.infer import GaussianPriors, fit_linear
from bayesdist.kinds.campaign.kind import campaign_checks, held_by_prior
from bayesdist.kinds.campaign.report.linear_terms import course_of, line_error
from bayesdist.kinds.campaign.report.lookup import binned_of, largest_cell, rms_of_cells
from bayesdist.missions.hst.published import LINES, published_lines
from bayesdist.missions.hst.simulate.distortion import DRIFT
from bayesdist.model import TimeDependence
from bayesdist.report.run_report import render_report
from bayesdist.report.sections import REPORT
from bayesdist.report.sections.fit import fit_tables
from bayesdist.report.sections.posterior import _parameter_table, coefficient_tables
from bayesdist.report.texttable import check_cells

from . import campaigns
from .plots import drawings_of, plot_of, plots_of, tables_of
from .runs import simulated, wise_model
from .test_html import parsed, words

MOST_MARKERS = 20_000


@pytest.fixture(scope="module")
def run():
    return campaigns.campaign_run()


@pytest.fixture(scope="module")
def plan(run, campaign_plots):
    """The figures that a campaign adds."""
    items = REPORT.items(run, "figure")
    return {
        one.name: campaign_plots[one.name] for one in items if one.section.startswith("campaign-")
    }


@pytest.fixture(scope="module")
def page(run, campaign_plots):
    return render_report(run, drawings_of(campaign_plots))


def number_in(text: str) -> float:
    """The number that a cell shows."""
    return float(text.replace("−", "-").split("\u202f")[0])


# -- the page -------------------------------------------------------------------------------------


def test_every_figure_of_the_plan_is_drawn_and_placed(run, campaign_plots, plan, page):
    parts = {s.name for s in REPORT.sections if s.parent == "campaign"}
    items = REPORT.items(run, "figure")
    assert {one.section for one in items if one.name in plan} == parts
    tree = lxml_html.fromstring(page)
    section = tree.get_element_by_id("campaign")
    shown = [f.get("id") for f in section.xpath(".//figure")]
    assert shown == [f"figure-{name}" for name in plan]
    images = section.xpath(".//figure//img")
    assert len(images) == len(plan)
    for image in images:
        png = base64.b64decode(image.get("src").split(",", 1)[1], validate=True)
        assert png.startswith(b"\x89PNG") and png.endswith(b"IEND\xaeB`\x82")
        assert len(image.get("alt")) > 20
    every = tree.xpath("//figure/@id")
    assert sorted(every) == sorted(f"figure-{name}" for name in campaign_plots)


def test_the_page_is_well_formed_and_its_links_lead_somewhere(page):
    parsed(page)
    tree = lxml_html.fromstring(page)
    ids = set(tree.xpath("//@id"))
    assert {h[1:] for h in tree.xpath("//nav//a/@href")} <= ids
    sections = tree.xpath("//section/@id")
    assert sections.index("campaign") == sections.index("data") + 1
    assert not re.search(r"\b(nan|None|inf)\b", words(page), re.IGNORECASE)


def test_binned_residuals_of_rolled_exposures_say_along_which_axes(run, campaign_plots):
    text = campaign_plots["residual_vectors"].text
    assert "cells of the test for structure" in text
    assert "axes of the polynomials" not in text  # frames that only shift turn nothing
    turning = replace(run.fit, model=replace(run.model, frames="shift_rotation"))
    text = plot_of(run.having(fit=turning), "residual_vectors").text
    assert "axes of the polynomials" in text


def test_no_figure_has_more_markers_than_a_reader_can_tell_apart(plan):
    for name, plot in plan.items():
        n = sum(len(line.get_xdata()) for ax in plot.figure.axes for line in ax.get_lines())
        assert n <= MOST_MARKERS, name


# -- captions against summary.json ----------------------------------------------------------------


def test_captions_say_the_numbers_of_the_summary(run, plan):
    found = run.summary
    matching, tables = found["matching"], found["tables"]
    text = plan["matching"].text
    assert f"{100 * matching['completeness']['median']:.1f}" in text
    assert f"{100 * matching['completeness']['least']:.1f}" in text
    assert "3.2\u202f×\u202f10⁻⁵" in text and "43\u202f210" in text
    text = plan["table_residuals"].text
    assert f"from {tables['rms_before']:.4f}" in text and f"to {tables['rms_after']:.4f}" in text
    assert "4\u202f964 of 5\u202f390" in plan["catalogue_errors"].text
    assert "51\u202f234 of 98\u202f765" in plan["fit_quality"].text
    for row in tables["chips"]:
        assert f"{row['sigma_median']:.3g}" in plan["table_errors"].text


def test_maps_of_residuals_tell_the_pattern_from_noise(run, plan):
    without, with_tables = (
        binned_of(run.report_data.residuals, which) for which in ("without", "with")
    )
    mean, noise = rms_of_cells(*without)
    assert mean > 5 * noise
    mean, noise = rms_of_cells(*with_tables)
    n = 2 * sum(b.count.size for b in with_tables)
    assert abs((mean / noise) ** 2 - 1) < 5 * np.sqrt(2 / n)  # chi-square of n cells
    for which, binned in (("without", without), ("with", with_tables)):
        text = plan[f"residuals_{which}_tables"].text
        assert f"{largest_cell(*binned):.3g}" in text


def test_the_overlap_shows_what_the_old_files_leave(run, plan):
    test = run.diagnostics.overlap
    sigma = 0.001 / 0.05  # pixels on each axis
    n = test.n_stars
    rms = np.sqrt(np.mean(test.new.rms**2))
    assert abs(rms / sigma - 1) < 4 / np.sqrt(4 * n)
    assert np.sqrt(np.mean(test.old.rms**2)) > 1.5 * sigma
    assert test.new.scale == pytest.approx(1 / 1.00003, abs=1e-5)
    assert abs(test.new.rotation) == pytest.approx(1.2, abs=1e-4)
    assert f"{rms:.3g}" in plan["overlap"].text


# -- tables against summary.json ------------------------------------------------------------------


def lines_of(run, term):
    for table in tables_of(run, "campaign-time"):
        if table.caption.startswith(f"{term} "):
            return table
    raise AssertionError(term)


@pytest.mark.parametrize("term", ["A_2", "B_2", "B_1"])
def test_rows_of_the_lines_are_those_of_the_summary(run, term):
    table = lines_of(run, term)
    factor = 1e3 if term == "B_1" else 1e6
    numbers = {c.name: c.number for c in run.model.chips}
    joint = {(r["chip"], r["epoch0"]): r for r in run.summary["lines"] if r["term"] == term}
    alone = {(r["term"], r["epoch0"]): r for r in run.summary["time_dependence"]["lines"]}
    seen = 0
    for chip, rdate, source, *cells in table.rows:
        if source == "joint fit":
            row = joint[numbers[chip], float(rdate)]
        elif source == "exposures, then line":
            row = alone[f"{chip}.{term}", float(rdate)]
        else:
            continue
        seen += 1
        alpha, sigma_alpha, beta, sigma_beta = (number_in(cell) for cell in cells)
        assert alpha == pytest.approx(row["alpha"], abs=0.06 * row["sigma_alpha"])
        assert sigma_alpha == pytest.approx(factor * row["sigma_alpha"], rel=5e-3)
        assert beta == pytest.approx(factor * row["beta"], abs=0.06 * factor * row["sigma_beta"])
        assert sigma_beta == pytest.approx(factor * row["sigma_beta"], rel=5e-3)
    assert seen == 2 * len(joint)


def test_what_the_gauge_fixes_is_no_row(run):
    captions = [t.caption for t in tables_of(run, "campaign-time")]
    assert not any(c.startswith("A_1") for c in captions)


def test_published_lines_are_those_that_the_simulation_starts_from(run):
    """Tables 1 to 3, copied twice from the report."""
    names = {"A_2": ("u", 1, 0), "B_2": ("v", 1, 0), "B_3": ("v", 0, 1)}
    for term, key in names.items():
        for one in LINES[term]:
            values = DRIFT[key][int(one.chip[-1])]
            s = 0 if one.rdate == 2004.5 else 2
            assert (one.alpha, one.beta) == values[s : s + 2]
    assert any("ACS ISR" in row[2] for row in lines_of(run, "A_2").rows)


def test_published_lines_stand_beside_acs_in_f606w_only():
    config = {"products": {"release": {"instrument": "ACS", "detector": "WFC"}}}
    other = {"products": {"release": {"instrument": "WFC3", "detector": "UVIS"}}}
    assert published_lines(config, "F606W", ("WFC1", "WFC2"))
    assert not published_lines(config, "F814W", ("WFC1", "WFC2"))
    assert not published_lines(other, "F606W", ("WFC1", "WFC2"))
    assert not published_lines(config, "F606W", ("CCD1",))


def test_files_and_their_dates(run):
    (table,) = tables_of(run, "campaign-release")
    assert [row[0] for row in table.rows] == ["acs_pre_idc.fits", "acs_d2i.fits"]
    assert table.rows[0][2] == "2002 to 2009.4" and number_in(table.rows[0][3]) == 0.012


# -- linear terms ---------------------------------------------------------------------------------


@pytest.mark.parametrize("label", ["WFC1.A_2", "WFC1.B_1"])
def test_vafactor_takes_the_aberration_out_of_the_scatter(label):
    series = campaigns.linear_series()
    course = course_of(series, campaigns.lines_alone(), label)
    scatter, n = campaigns.unit_of(label), campaigns.N
    assert abs(course.rms / scatter - 1) < 4 / np.sqrt(2 * n)
    aberration = campaigns.ALPHA[label] * np.std(series.vafactor)
    expected = np.hypot(aberration, scatter)
    assert course.rms_raw == pytest.approx(expected, rel=0.25)
    # without the drift the exposures of a segment lie about one value
    flat = course.value - course.drift
    for s in (0, 1):
        mean = flat[series.segment == s].mean()
        assert abs(mean - course.alpha[s]) < 4 * scatter / np.sqrt(n / 2)


def test_bands_are_exact_between_the_dates_of_the_file():
    """The error of a line is known everywhere once three dates of its segment are."""
    series = campaigns.linear_series()
    for s, t in ((0, [2002.5, 2006.1, 2009.4]), (1, [2009.4, 2011.7, 2014.4])):
        for label in campaigns.LABELS:
            sigma = campaigns.line_sigma(label, t, s)
            new = np.hypot(sigma, campaigns.unit_of(label))
            for column, expected in (("sigma", sigma), ("sigma_new", new)):
                found = line_error(series, f"{column}_{label}", s, np.array(t))
                np.testing.assert_allclose(found, expected)


def test_outlying_exposures_are_marked_and_do_not_count():
    series = campaigns.linear_series()
    series.exposures["WFC2.A_2"][7] += 1e-3
    course = course_of(series, campaigns.lines_alone(), "WFC2.A_2")
    assert course.rms < 1.5 * campaigns.SCATTER
    with_it = course_of(
        replace(series, exposures=_believed(series.exposures)), campaigns.lines_alone(), "WFC2.A_2"
    )
    assert with_it.rms > 10 * campaigns.SCATTER


def _believed(table):
    out = table.copy()
    out["outlier_probability"] = 0.0
    return out


# -- other campaigns ------------------------------------------------------------------------------


def test_tables_of_a_filter_have_figures_of_their_own(run):
    chips = run.model.chips
    both = tuple(campaigns.pattern(c.number, f) for f in ("", "F814W") for c in chips)
    changed = run.having(tables=StoredLookupTables(both))
    names = {"table_nodes", "table_nodes_F814W", "table_errors_F814W", "residuals_without_tables"}
    plan = plots_of(changed, *names)
    assert set(plan) == names
    assert "detector's tables alone" in plan["residuals_without_tables"].title
    for name in ("table_nodes_F814W", "table_errors_F814W"):
        assert plan[name].figure.axes


def test_a_campaign_without_tables_drift_and_overlap(run):
    bare = {k: v for k, v in run.summary.items() if k in ("matching", "gauge", "scatter")}
    one = run.report_data.residuals
    plain = tuple(replace(c, with_tables=None, binned_with=None) for c in one)
    less = replace(run.report_data, residuals=plain, series=None, catalog=None, detections=None)
    small = run.having(
        report_data=less,
        summary=bare | {"tables": {"method": "none"}},
        overlap=None,
        tables=StoredLookupTables(),
    )
    page = render_report(small, drawings_of(plots_of(small)))
    parsed(page)
    shown = lxml_html.fromstring(page).get_element_by_id("campaign").xpath(".//figure/@id")
    assert shown == [f"figure-{n}" for n in ("matching", "footprints", "residuals_without_tables")]


def test_series_without_rolls_are_drawn_against_time_only(run):
    series = run.report_data.series
    bare = replace(series, pa_v3=np.full(len(series.pa_v3), np.nan))
    plot = plot_of(run.having(report_data=replace(run.report_data, series=bare)), "series_A_2")
    assert len(plot.figure.axes) == 6  # three states of two chips
    assert "PA_V3" not in plot.text


def test_many_chips_have_several_figures(run):
    series = run.report_data.series
    table = series.exposures.copy()
    for column in ("WFC2.A_2", "sigma_WFC2.A_2"):
        table[column.replace("WFC2", "WFC3")] = table[column]
    drift = series.drift.copy()
    for column in ("sigma_WFC2.A_2", "sigma_new_WFC2.A_2"):
        drift[column.replace("WFC2", "WFC3")] = drift[column]
    lines = [*campaigns.lines_alone()]
    lines += [r | {"term": "WFC3.A_2"} for r in lines if r["term"] == "WFC2.A_2"]
    time = run.summary["time_dependence"] | {"lines": lines}
    more = replace(run.report_data, series=replace(series, exposures=table, drift=drift))
    summary = run.summary | {"time_dependence": time}
    assert plot_of(run.having(report_data=more, summary=summary), "series_A_2_2").figure.axes


# -- status ---------------------------------------------------------------------------------------


def levels(summary):
    return {c.name: c.level for c in campaign_checks(summary)}


def test_a_good_campaign_passes(run):
    assert set(levels(run.summary).values()) <= {"pass", "note"}


@pytest.mark.parametrize(
    ("section", "changes", "name"),
    [
        ("matching", {"completeness": {"median": 0.9, "least": 0.3}}, "completeness"),
        ("matching", {"false_fraction": 0.1}, "false pairs"),
        ("matching", {"left_out": {"e001": "no match"}}, "left out"),
        ("tables", {"converged": False}, "tables converged"),
        ("time_dependence", {"converged": False}, "Series"),
    ],
)
def test_what_went_wrong_is_on_top(run, section, changes, name):
    found = run.summary
    bad = found | {section: found[section] | changes}
    warned = [n for n, level in levels(bad).items() if level == "warn"]
    assert len(warned) == 1 and name in warned[0]


def test_doubts_are_on_top(run):
    found = run.summary
    section = found["time_dependence"] | {"warnings": ["the rates are doubtful"]}
    *_, last = campaign_checks(found | {"time_dependence": section})
    assert last.level == "warn" and check_cells(last)[0] == "The rates are doubtful"


def row_of_structure(misfits):
    (row,) = [c for c in structure_checks(misfits) if "Structure" in c.name]
    return row


def test_what_the_banner_warns_of_has_a_row(run):
    """The verdict of the row is that of the warning, and doubts of another kind say so."""
    first, second = run.model.chips
    for p, level in ((1.0, "pass"), (2e-4, "pass"), (1e-5, "warn"), (0.0, "warn")):
        found = (Misfit(p, "cells", 0.0021, "pix", first), Misfit(1, "rows", 0, "pix", second))
        row = row_of_structure(found)
        assert row.level == level
        assert row.value.startswith("0.0021\u202fpix rms in cells of WFC1, p ")
    assert row.value.endswith("p < 10⁻³⁰⁰")


def test_no_structure_is_no_length(run):
    chip = run.model.chips[0]
    assert row_of_structure((Misfit(1.0, "rows", 0.0, "pix", chip),)).value == "none, p = 1.0"


# -- what is no measurement -----------------------------------------------------------------------


def time_rows(run):
    (table,) = [t for t in coefficient_tables(run) if t.caption.startswith("Time dependence")]
    return [row[0] for row in table.rows], table.note


def test_held_parameters_are_no_rows(run):
    before, note = time_rows(run)
    assert "Held" not in note
    rate = next(name for name in before if name.startswith("WFC2.tdd"))
    held = run.having(held_parameters=frozenset({rate}))
    after, note = time_rows(held)
    assert [name for name in before if name != rate] == after
    assert f"{rate.rpartition('.')[0]} (rate)" in note
    (fit, *_) = fit_tables(held)
    assert "1 of them held" in dict(fit.rows)["Parameters"]


def test_a_prior_holds_what_the_data_do_not_narrow():
    """Stars narrow a prior as wide as their own errors, and not one of a thousandth of them."""
    table, model = simulated(2000), wise_model()
    free = fit_linear(table, model)
    sigma = dict(zip(model.names, free.sigma, strict=True))
    wide, narrow, frame = "u_2_0", "tdd.u_1_0.rate", "frame1.shift_u"
    priors = GaussianPriors.of(
        model,
        {wide: (0.0, sigma[wide]), narrow: (0.0, 1e-3 * sigma[narrow]),
         frame: (0.0, 1e-3 * sigma[frame])},
    )  # fmt: skip
    assert held_by_prior(fit_linear(table, model, priors=priors), priors) == {narrow}
    assert not held_by_prior(free, GaussianPriors.none(model))


def test_the_terms_that_were_asked_for_are_named(run):
    time = TimeDependence((("u", 1, 0), ("u", 0, 0)), (2009.0, 2011.0), (2010.0,))
    model = replace(run.model, time=time)
    every = [p.name for p in model.parameters if p.kind == "tdd" and (p.i, p.j) == (0, 0)]
    held = tuple(n for n in every if n.startswith("WFC1") or ".rate" in n)
    config = run.configuration | {"model": {"tdd": {"terms": [["u", 1, 0]]}}}
    gap = run.having(
        configuration=config,
        fit=replace(run.fit, model=model),
        held_parameters=frozenset(held),
    )
    text = dict(fit_tables(gap)[0].rows)["Time-dependent terms"]
    assert text == "u_1_0; besides, the constants of WFC2 may step at 2010.00"
    still = gap.having(held_parameters=frozenset(every))
    assert dict(fit_tables(still)[0].rows)["Time-dependent terms"] == "u_1_0"


def test_small_ratios_are_shown_by_the_million(run):
    (table,) = [t for t in coefficient_tables(run) if t.caption.startswith("Time dependence")]
    units = {row[0]: row[-1] for row in table.rows}
    assert {u for n, u in units.items() if "shift" in n} == {"pix"}
    name = next(n for n in units if "shift" in n)
    bare = coefficient_table(run.fit, run.solution)
    k = list(bare["name"]).index(name)
    for column in ("lsq_value", "lsq_sigma", "mean", "sd", "lo68", "hi68", "lo95", "hi95"):
        bare[column][k] *= 1e-7
    bare["unit"][k] = ""
    value, sigma = bare["lsq_value"][k], bare["lsq_sigma"][k]
    (row,) = _parameter_table(run, "", [bare[k]], with_unit=True).rows
    assert row[-1] == "10⁻⁶"
    assert abs(1e-6 * number_in(row[1]) - value) < 0.06 * sigma
    assert number_in(row[2]) == pytest.approx(1e6 * sigma, rel=0.05)


# -- gauges ---------------------------------------------------------------------------------------


def test_every_table_says_in_which_system_it_is(run, page):
    text = words(page)
    for table in tables_of(run, "campaign-time"):
        if "TIME − RDATE" in table.caption:
            assert "in the system of WFC2" in table.caption
    for table in coefficient_tables(run):
        assert "in the fit's own gauge" in table.caption
    assert "A_1, B_1, A_3 of WFC2 are zero in it" in text
    assert "a new exposure whose shift and rotation are fitted" in text


def test_two_errors_side_by_side_are_explained_once(run):
    notes = [t.note for t in tables_of(run, "campaign-time")]
    assert sum("two σ of this run may differ" in note for note in notes) == 1
