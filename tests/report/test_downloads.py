"""Numbers of figures as CSV, and the pages of the documentation that the page names."""

from __future__ import annotations

import base64
import csv
import io
from pathlib import Path

import numpy as np
from lxml import html as lxml_html

from bayesdist.report.contents import explanation_of, section_of
from bayesdist.report.drawing import numbers_of
from bayesdist.report.run import shown_residuals
from bayesdist.report.run_report import render_report
from bayesdist.report.sections import REPORT
from bayesdist.report.sections.status import GROUPS

from .plots import drawings_of, plot_of

DOCS = Path(__file__).resolve().parents[2] / "docs"


def rows_of(text: str) -> list[dict[str, str]]:
    lines = [line for line in text.splitlines(keepends=True) if not line.startswith("#")]
    return list(csv.DictReader(io.StringIO("".join(lines))))


def test_numbers_are_those_that_are_drawn(converged):
    figure = plot_of(converged, "chi_square_by_exposure").figure
    drawn = figure.axes[0].lines[-1].get_xydata()
    rows = [r for r in rows_of(numbers_of(figure)) if r["mark"] == "line"]
    found = np.array([[float(r["x"]), float(r["y"])] for r in rows])
    np.testing.assert_allclose(found[-len(drawn) :], drawn, rtol=1e-5)


def test_cells_have_their_places_and_values(converged):
    rows = rows_of(numbers_of(plot_of(converged, "coverage").figure))
    binned = shown_residuals(converged)[0]
    assert sum(float(r["value"]) for r in rows) == binned.count.sum()
    first = rows[0]
    assert float(first["x"]) == binned.x[0] and float(first["y"]) == binned.y[0]
    assert float(first["value"]) == binned.count[0, 0]


def test_a_matrix_is_read_from_the_top(converged):
    figure = plot_of(converged, "correlations").figure
    values = figure.axes[0].images[0].get_array()
    rows = {(float(r["x"]), float(r["y"])): float(r["value"]) for r in rows_of(numbers_of(figure))}
    for i, j in ((0, 0), (3, 1), (0, 5)):
        assert abs(rows[j, i] - values[i, j]) < 1e-5


def test_numbers_are_in_the_page_and_what_they_hold_cannot_leave_them(converged):
    from dataclasses import replace

    plot = plot_of(converged, "chi_square_by_exposure")
    (drawing,) = drawings_of({"a": plot}).values()
    evil = '"><script>alert(1)</script>'
    drawings = {"chi_square_by_exposure": replace(drawing, numbers=evil)}
    page = render_report(converged, drawings)
    assert evil not in page
    (link,) = lxml_html.fromstring(page).xpath("//a[@download]")
    assert link.get("download") == "chi_square_by_exposure.csv"
    assert base64.b64decode(link.get("href").partition("base64,")[2]).decode() == evil


def test_each_section_names_a_page_and_a_heading_that_exist():
    for section in REPORT.sections:
        page, heading = section.explained
        lines = (DOCS / f"{page}.md").read_text("utf-8").splitlines()
        assert not heading or f"## {heading}" in lines, section.name
        assert explanation_of(section.name).startswith(f"bayesdist docs {page}")


def test_groups_of_the_status_table_link_to_sections(converged):
    page = lxml_html.fromstring(render_report(converged, {}))
    links = page.xpath("//a[@class='help']/@href")
    assert len(links) >= 3
    assert {link.removeprefix("#") for link in links} <= set(page.xpath("//section/@id"))
    assert all(section_of(group) in {s.name for s in REPORT.sections} for group in GROUPS)
