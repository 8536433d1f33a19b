"""Summary of a run for notebooks: verdict first, everything escaped, never long."""

from __future__ import annotations

import re
import subprocess
import sys
from html import unescape
from html.parser import HTMLParser

import numpy as np
import pytest

from bayesdist.report.html import (
    COLORS,
    MAX_ROWS,
    MAX_WARNINGS,
    RunSummary,
    budget_rows,
    margin_rows,
    summary_html,
    summary_text,
)

NASTY = "<script>alert(\"x\")</script> & 'more' </td>"


class Page(HTMLParser):
    """Tags, attributes and text of a block of HTML, whose tags must be closed in order."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open, self.tags, self.styles, self.texts = [], [], [], []
        self.feed(html)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)
        self.tags.append(tag)
        named = dict(attrs)
        assert set(named) <= {"style", "scope", "colspan"}
        self.styles.append(named.get("style", ""))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if data.strip():
            self.texts.append(data)


@pytest.fixture(scope="module")
def summary(converged):
    return RunSummary(
        "WISE W2",
        "fail",
        "One of three requirements is missed: worst corner.",
        ("Structure remains in the residuals.",),
        (("stars", "6 000"), ("exposures", "4"), ("sampler", "converged, R-hat 1.004")),
        margin_rows(converged.evaluation.margins),
        budget_rows(converged.evaluation.budget, scale_mas=2757.0),
    )


def test_verdict_and_warnings_come_before_the_numbers(summary):
    for text in ("\n".join(Page(summary_html(summary)).texts), summary_text(summary)):
        places = [
            text.index(words)
            for words in ("WISE W2", "worst corner.", "Structure", "6 000", "Margins", "budget")
        ]
        assert places == sorted(places)


def test_all_text_is_escaped():
    row = {NASTY: NASTY, "Verdict": "met"}
    everything = RunSummary(NASTY, "warn", NASTY, [NASTY], [(NASTY, NASTY)], [row], [row])
    html = summary_html(everything)
    page = Page(html)
    assert set(page.tags) <= {"div", "b", "ul", "li", "table", "caption", "thead", "tbody"} | {
        "tr",
        "th",
        "td",
    }
    assert "<script" not in html and unescape(html).count(NASTY) == 9
    assert summary_text(everything).count("<script>") == 9


def test_it_has_no_script_and_no_colours_of_a_theme(summary):
    page = Page(summary_html(summary))
    colours = {c for style in page.styles for c in re.findall(r"#[0-9A-Fa-f]{3,6}", style)}
    assert colours <= set(COLORS.values())
    for style in page.styles:
        assert not re.search(r"background(?!:none)", style)
    for colour in COLORS.values():  # at least 2.1 to 1, for marks that words repeat
        channels = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
        linear = np.where(
            channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4
        )
        luminance = linear @ [0.2126, 0.7152, 0.0722]
        assert 1.05 / (luminance + 0.05) > 2.1 and (luminance + 0.05) / 0.05 > 2.1


def test_it_stays_short_however_large_the_run_is():
    rows = [{"Term": f"term {k}", "Size": f"{k}.5"} for k in range(300)]
    rows.append({"Term": "total", "Size": "9"})
    long = RunSummary("many", "warn", "Undecided", ["warning"] * 90, (), rows, rows)
    html, text = summary_html(long), summary_text(long)
    assert len(Page(html).texts) < 200 and len(text.splitlines()) < 60
    for shown in (unescape(html), text):
        assert shown.count("warning") == MAX_WARNINGS
        assert f"… {90 - MAX_WARNINGS + 1} more warnings" in shown
        assert f"… {301 - MAX_ROWS + 1} more rows" in shown
        assert shown.count("total") == 2 and "term 9\n" not in shown and "term 10" not in shown


def test_rows_have_the_numbers_of_the_margins_and_the_budget(converged):
    for row, m in zip(
        margin_rows(converged.evaluation.margins), converged.evaluation.margins, strict=True
    ):
        assert float(row["Value"]) == pytest.approx(m.value, rel=0.05)
        assert row["Verdict"] == m.verdict and row["Requirement"] == m.requirement.name
        assert f"≤ {m.requirement.limit:g} pix" in row["Limit"]
    rows = budget_rows(converged.evaluation.budget, scale_mas=2757.0)
    terms = converged.evaluation.budget.rows()
    assert [row["Term"] for row in rows] == [term["name"] for term in terms]
    for row, term in zip(rows, terms, strict=True):
        per_axis = term["radial"] / np.sqrt(2)
        assert float(row["Per axis [pix]"]) == pytest.approx(per_axis, rel=6e-3)
        assert row["As an angle"].endswith("mas")
        angle = float(row["As an angle"].split("\u202f")[0].split()[0])
        assert angle == pytest.approx(2757.0 * per_axis, rel=6e-3)
    assert "As an angle" not in budget_rows(converged.evaluation.budget)[0]


def test_lines_of_text_fit_a_terminal_and_columns_stand_below_each_other(summary):
    lines = summary_text(summary).splitlines()
    assert max(map(len, lines)) <= 100
    start = lines.index("Error budget") + 1
    ends = {len(line[: line.index("Per axis [pix]")]) for line in lines[start : start + 1]}
    (end,) = ends
    cells = [line[end : end + len("Per axis [pix]")] for line in lines[start + 1 :]]
    assert all(cell.strip() and cell[-1].isdigit() for cell in cells)


def test_a_summary_does_not_import_matplotlib():
    code = (
        "import sys; from bayesdist.report.html import RunSummary, summary_html;"
        " from bayesdist.report.run_plots import RunPlots;"
        " summary_html(RunSummary('a', 'pass', 'b')); print('matplotlib' in sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"
