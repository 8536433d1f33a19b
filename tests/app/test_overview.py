"""One page for many runs, from what each has in its summary."""

from __future__ import annotations

import json

import pytest
from lxml import html as lxml_html

from bayesdist.app.report import overview
from bayesdist.errors import InputError
from bayesdist.report.run_report import OverviewRow, write_overview
from tests.app.support import cli

ROW = OverviewRow(
    name="a", link="a/report.html", detector="WISE W2", simulated=False, level="pass",
    headline="Every requirement is met at epoch 2010.30", worst_margin=12.3,
    worst_requirement="field", valid_until=2020.3, open_ended=True, epoch=2010.3,
    uncertainty="0.01 pix", n_used=1234, chi2_per_dof=1.02, began="2026-11-24T14:57:06+00:00",
)  # fmt: skip


def test_the_worst_run_stands_first_and_all_have_their_cells(tmp_path):
    from dataclasses import replace

    bad = replace(ROW, name="<b>&", level="fail", worst_margin=-40.0, simulated=True)
    empty = replace(
        ROW, name="c", level="note", link="", worst_margin=None, worst_requirement="",
        valid_until=None, open_ended=False, epoch=None, uncertainty="", n_used=None,
        chi2_per_dof=None,
    )  # fmt: skip
    worse = replace(bad, name="worse", worst_margin=-41.0)
    write_overview(tmp_path / "all.html", [ROW, empty, bad, worse])
    tree = lxml_html.fromstring((tmp_path / "all.html").read_text("utf-8"))
    rows = tree.xpath("//tbody/tr")
    names = [row.xpath("./th")[0].text_content().split() for row in rows]
    assert names == [["worse", "SIMULATED"], ["<b>&", "SIMULATED"], ["a"], ["c"]]
    heads = [head.text_content() for head in tree.xpath("//thead//th")]
    _, first, second, third = ([cell.text_content() for cell in row] for row in rows)
    assert first[heads.index("Worst margin [% of the limit]")] == "\N{MINUS SIGN}40"
    assert second[heads.index("Valid until [yr]")] == "2020.3 or later"
    assert third[4:11] == 7 * ["–"]
    keys = [int(row.xpath("./td/@data-key")[0]) for row in rows]
    assert keys == sorted(keys)
    assert [link.get("href") for link in tree.xpath("//tbody//a")] == 3 * ["a/report.html"]


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        overview([tmp_path / "none"], tmp_path / "all.html")
    assert not (tmp_path / "all.html").exists()


def test_a_run_has_its_row(finished, tmp_path):
    summary = json.loads((finished.path / "summary.json").read_text())
    text = overview([finished.path], tmp_path / "all.html")
    row = f"{finished.path.as_posix()} {summary['verdict']['headline']}"
    assert row in " ".join(text.split()) and text.endswith("all.html")
    page = (tmp_path / "all.html").read_text("utf-8")
    (row,) = lxml_html.fromstring(page).xpath("//tbody/tr")
    cells = [cell.text_content().strip() for cell in row]
    assert summary["verdict"]["headline"] in cells
    assert f"{min(m['margin_percent'] for m in summary['margins']):.0f}" in [
        cell.replace("\N{MINUS SIGN}", "-") for cell in cells
    ]


def test_the_report_of_one_run_is_its_own(finished, tmp_path, monkeypatch):
    """Without -o no page of many runs is made: report.html is drawn again."""
    monkeypatch.chdir(tmp_path)
    report = finished.path / "report.html"
    before = report.stat().st_mtime_ns
    result = cli("report", finished.path)
    assert result.code == 0 and report.stat().st_mtime_ns > before
    assert result.out.strip() == str(report)
    assert not (tmp_path / "reports.html").exists()
