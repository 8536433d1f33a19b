"""First screen of the report: verdicts with their numbers, what was measured, three figures."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from lxml import html as lxml_html

from bayesdist.report.drawing import Drawing
from bayesdist.report.run_report import render_report
from bayesdist.report.sections.status import (
    facts_line,
    requirement_lines,
    status_table,
    verdict,
)
from bayesdist.utils.checks import Check


def test_each_requirement_has_value_limit_and_probability_in_the_unit_of_its_limit(converged):
    settings = replace(converged.evaluation.settings, scale_mas=2750.0)
    run = converged.having(settings=settings)
    lines = requirement_lines(run)
    assert len(lines) == len(run.evaluation.margins) > 1
    for m, line in zip(run.evaluation.margins, lines, strict=True):
        assert line.verdict == m.verdict.upper()
        found = re.search(
            r"([\d.]+)\u202fpix \(([\d.]+)\u202f(mas|arcsec)\), limit ([\d.]+)\u202fpix", line.text
        )
        value, angle, limit = (float(found[k]) for k in (1, 2, 4))
        assert value == pytest.approx(m.value, rel=0.01)
        in_mas = angle * {"mas": 1, "arcsec": 1000}[found[3]]
        assert in_mas == pytest.approx(2750 * m.value, rel=0.01)
        assert limit == m.requirement.limit
        assert line.text.startswith(f"{m.requirement.name}: {m.requirement.statistic} ")


def test_lengths_on_a_focal_plane_are_given_in_micrometres(converged):
    """Angles over the plate scale; a pixel has none, and stays as it is."""
    run = converged.having(configuration={"data": {"plate_scale": 20.0}})
    angles = tuple(replace(m, unit="mas", value=3.0) for m in run.evaluation.margins)
    for line in requirement_lines(run.having(margins=angles)):
        assert "\u202fmas (0.150\u202fµm), limit" in line.text  # 3 mas / (20 arcsec / mm)
    assert not any("µm" in line.text for line in requirement_lines(run))


def test_positions_off_the_field_are_left_out_of_the_first_sentence(converged):
    """The map is NaN there: the errors are those of the positions that see the sky."""
    (whole,) = converged.evaluation.maps
    kept = np.zeros(whole.sigma_u.shape, bool)
    kept[1, 2] = True
    names = ("sigma_u", "sigma_v", "correlation")
    seen = replace(whole, **{name: np.where(kept, getattr(whole, name), np.nan) for name in names})
    field = converged.having(maps=(seen,))
    (size,) = np.hypot(whole.sigma_u[kept], whole.sigma_v[kept]) / np.sqrt(2)
    sentence = verdict(field).sentences[-1]
    found = re.search(r"is ([\d.]+)\u202fpix .*? at most ([\d.]+)\u202fpix", sentence)
    assert found, sentence
    assert [float(text) for text in found.groups()] == pytest.approx([size, size], rel=0.01)


def test_probability_near_one_is_a_bound(converged):
    """With n draws in none of which the limit is exceeded, P is stated as above 1 - 1/n."""
    sure = replace(
        converged.evaluation.margins[0], probability_met=1.0, mc_error=0.0, n_effective=1600
    )
    (line,) = requirement_lines(converged.having(margins=(sure,)))
    assert line.text.endswith(", P > 0.9993")


def test_facts_name_what_was_measured(converged):
    config = {"detector": {"mission": "WISE", "instrument": "", "name": "W2", "filter": "F1"}}
    run = converged.having(configuration=config, provenance={"versions": {"bayesdist": "1.2.3"}})
    facts = facts_line(run).split(" · ")
    n = f"{run.fit.n_used:,}".replace(",", "\u202f")
    assert facts[0] == f"{n} of 6\u202f000 stars used"
    assert facts[1] == "4 exposures"
    assert facts[-3:] == ["WISE W2", "F1", "bayesdist 1.2.3"]


def test_three_figures_stand_on_top_and_nowhere_else(page):
    tree = lxml_html.fromstring(page)
    top = tree.xpath("//section[@id='status']//figure/@id")
    assert top == ["figure-margins", "figure-uncertainty_radius", "figure-distortion"]
    every = tree.xpath("//figure/@id")
    assert len(every) == len(set(every))
    links = tree.xpath("//section[@id='maps']/p/a/@href")
    assert links == ["#figure-uncertainty_radius", "#figure-distortion"]


def test_figures_and_tables_are_numbered_from_one_in_the_order_of_the_page(page):
    tree = lxml_html.fromstring(page)
    figures = [b.get("data-number") for b in tree.xpath("//figcaption/b")]
    assert figures == [f"Figure {k}. " for k in range(1, len(figures) + 1)]
    tables = list(dict.fromkeys(c.get("data-number") for c in tree.xpath("//caption")))
    assert tables == [f"Table {k}. " for k in range(1, len(tables) + 1)]


def test_rows_that_fail_or_warn_are_open_and_those_that_pass_are_folded(converged):
    rows = [Check("Sampling", "odd", 1.0, "0", "warn"), Check("Fit", "good", 1.0, "2", "pass")]
    run = converged.having(checks=tuple(rows))
    tree = lxml_html.fromstring(render_report(run, {}))
    status = tree.xpath("//section[@id='status']")[0]
    folded = status.xpath(".//details//span/@class")
    assert folded and set(folded) == {"level pass"}
    shown = status.xpath(".//td/span[not(ancestor::details)]/@class")
    assert "level warn" in shown and "level pass" not in shown
    groups = list(dict.fromkeys(row[0] for row in status_table(run).rows))
    assert groups == ["Requirements", "Fit", "Sampling"]


def test_a_small_run_has_ten_screens(converged, plots, browser, tmp_path):
    """At 1440 x 900 pixels, with pictures as large as the figures are; nothing is wider."""
    drawn = {}
    for name, plot in plots.items():
        width, height = plot.figure.get_size_inches()
        blank = f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}in" height="{height}in"/>'
        words = {"title": plot.title, "text": plot.text, "alt": plot.alt}
        drawn[name] = Drawing(blank.encode(), "svg", width, **words)
    path = tmp_path / "report.html"
    path.write_text(render_report(converged, drawn), encoding="utf-8")
    size = {"width": 1440, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        browser.get(path.as_uri())
        root = "document.documentElement"
        found = browser.execute_script(f"return [{root}.scrollHeight, {root}.scrollWidth]")
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert found[0] <= 10 * 900
    assert found[1] <= 1440
