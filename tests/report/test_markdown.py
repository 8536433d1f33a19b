"""report.md: the same tables, figures and words as the page."""

from __future__ import annotations

import html
import re
from dataclasses import replace

import pytest
from lxml import html as lxml_html

from bayesdist.report.run_report import STRIP, render_markdown, render_report, write_report
from bayesdist.utils.checks import Check


@pytest.fixture(scope="module")
def text(converged, drawings) -> str:
    return render_markdown(converged, drawings)


def cells(line: str) -> list[str]:
    """Texts of a row, as a reader of Markdown sees them."""
    parts = re.split(r"(?<!\\)\|", line.strip())[1:-1]
    return [html.unescape(re.sub(r"\\(.)", r"\1", p)).strip() for p in parts]


def test_every_row_of_the_page_stands_in_it(text, page):
    rows = {tuple(cells(line)) for line in text.splitlines() if line.startswith("|")}
    tree = lxml_html.fromstring(page)
    found = 0
    for table in tree.xpath("//table[contains(@class, 'grid') or contains(@class, 'listing')]"):
        for row in table.xpath(".//tbody/tr"):
            assert tuple(c.text_content().strip() for c in row) in rows
            found += 1
    assert found > 80


def test_headings_figures_and_captions_are_those_of_the_page(text, page):
    tree = lxml_html.fromstring(page)
    titles = [h.text_content() for h in tree.xpath("//h2")]
    assert re.findall(r"^## (.*)$", text, re.MULTILINE) == titles
    links = re.findall(r"^!\[(.*)\]\(figures/(\w+)\.(?:png|svg)\)$", text, re.MULTILINE)
    names = [name for _, name in links]
    on_top = [name for name in STRIP if name in names]
    others = [name for name in names if name not in STRIP]
    assert [f"figure-{name}" for name in on_top + others] == tree.xpath("//figure/@id")
    for caption in tree.xpath("//figcaption"):
        title, _, words = caption.text_content().partition(". ")
        assert f"**{title}.** {words.strip()}" in text.replace("\\", "")


def test_every_row_of_a_table_has_as_many_cells_as_its_head(text):
    lines = text.splitlines()
    for n, line in enumerate(lines):
        if re.match(r"^\| :?---", line):
            width = len(cells(lines[n - 1]))
            assert len(cells(line)) == width
            below = lines[n + 1]
            assert below.startswith("|") and len(cells(below)) == width


def test_what_a_user_writes_does_not_become_markup(converged, drawings):
    evil = "a|b *c* <script> [x](y)"
    out = render_markdown(
        replace(
            converged,
            name=evil,
            checks=(*converged.checks, Check("Fit", "A name", level="warn", sentence=evil)),
        ),
        drawings,
    )
    assert "<script" not in out and "[x](y)" not in out.replace("\\[x](y)", "")
    assert "a\\|b \\*c\\*" in out


def test_doubts_are_marked(not_converged, drawings):
    out = render_markdown(not_converged, drawings)
    assert "**NOT CONVERGED.**" in out and "†" in out


def test_it_lies_beside_the_page(converged, drawings, tmp_path):
    write_report(tmp_path / "report.html", converged, drawings)
    assert (tmp_path / "report.md").read_text(encoding="utf-8") == render_markdown(
        converged, drawings
    )
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == render_report(
        converged, drawings
    )
