"""Everything that a page can show: named once, with needs that exist, in its place when it is."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from bayesdist.app.parts import StoredLookupTables
from bayesdist.assess.evaluation import Evaluation
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.diagnose.holdout.validation import HoldoutValidation
from bayesdist.infer import Posterior
from bayesdist.kinds.campaign.report.data import CampaignData
from bayesdist.missions.wise.bands.command import BANDS
from bayesdist.missions.wise.bands.context import BandsInput
from bayesdist.report.contents import PageSection, Plot, Registry
from bayesdist.report.page import parts_of
from bayesdist.report.run import ReportedRun
from bayesdist.report.run_report import STRIP, render_report
from bayesdist.report.sections import REPORT
from bayesdist.report.texttable import Level, TextTable

from .campaigns import campaign_run
from .plots import drawings_of

DOCS = Path(__file__).resolve().parents[2] / "docs"
PARTS = {
    "evaluation": Evaluation,
    "diagnostics": Diagnostics,
    "diagnostics.holdout": HoldoutValidation,
    "posterior": Posterior,
    "tables": StoredLookupTables,
    "report_data": CampaignData,  # self-calibrations need none of theirs by name
}
NEEDED = {
    "report": {name for name, member in vars(ReportedRun).items() if isinstance(member, property)}
    | {f"{part}.{f.name}" for part, kind in PARTS.items() for f in dataclasses.fields(kind)},
    "bands": {f.name for f in dataclasses.fields(BandsInput)},
}


@pytest.mark.parametrize("registry", [REPORT, BANDS], ids=lambda one: one.name)
def test_entries_have_names_of_their_own_and_needs_that_exist(registry):
    figures = [one.name for one in registry.entries if one.kind == "figure"]
    assert len(figures) == len(set(figures))
    named = {section.name for section in registry.sections}
    for one in registry.entries:
        assert set(one.needs) <= NEEDED[registry.name], one.name
        assert one.section in named | {""} and one.make.__doc__, one.name


def test_figures_and_words_stand_in_the_page(campaign_plots):
    run, plots = campaign_run(), campaign_plots
    for name, plot in plots.items():
        assert plot.title and plot.text and len(plot.alt) > 20, name
    drawings = drawings_of(plots)
    page = render_report(run, drawings)
    on_top = [name for name in STRIP if name in plots]
    others = [name for name in plots if name not in STRIP]
    assert re.findall(r'<figure id="figure-(\w+)"', page) == on_top + others


def test_what_is_not_there_is_not_shown(converged):
    shown = {one.name for one in REPORT.items(converged, "figure")}
    absent = {
        one.name
        for one in REPORT.entries
        if one.section.startswith(("campaign", "selfcal", "holdout"))
    }
    assert absent and not shown & absent


def test_the_table_of_figures_in_the_documentation_is_the_registry():
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \|$", (DOCS / "report.md").read_text("utf-8"), re.M)
    entries = [one for one in REPORT.entries if one.kind == "figure"]
    lines = [(one.name, one.make.__doc__.strip().split("\n")[0]) for one in entries]
    assert rows == [(name, text.rstrip(".")) for name, text in lines]


def test_two_entries_of_one_name_are_refused():
    registry = Registry("small", (PageSection("one", "One"),))
    registry.figure("one")(lambda r: None)
    with pytest.raises(ValueError, match="two entries"):
        registry.figure("one")(lambda r: None)


def test_a_page_of_its_own_needs_no_change_elsewhere():
    """Sections that hold nothing are left out, or say why they do; parts stand in theirs."""
    registry = Registry(
        "small",
        (
            PageSection("all", "All"),
            PageSection("part", lambda r: r.title, parent="all"),
            PageSection("nothing", "Nothing"),
            PageSection("missing", "Missing", empty="None was made."),
        ),
    )

    @registry.table("part", needs=("numbers",))
    def table(r):
        return TextTable("Numbers", ("n",), tuple((str(n),) for n in r.numbers))

    @registry.figure("part", each=lambda r: {f"figure_{n}": n for n in r.numbers}, printed=True)
    def figure(r, n):
        return Plot(None, f"Number {n}", "", "")

    @registry.figure("part", printed=lambda r: len(r.numbers) > 2)
    def summary(r):
        return Plot(None, "All numbers", "", "")

    results = SimpleNamespace(title="A part", numbers=(3, 5))
    items = registry.items(results, "figure")
    printed = [("figure_3", True), ("figure_5", True), ("summary", False)]
    assert [(one.name, one.printed) for one in items] == printed
    more = registry.items(SimpleNamespace(title="", numbers=(1, 2, 3)), "figure")
    assert all(one.printed for one in more)
    assert items[1].made(results).title == "Number 5"
    every, missing = parts_of(registry, results, {})
    assert [part.title for part in every.parts] == ["A part"]
    assert every.parts[0].tables[0].rows == (("3",), ("5",))
    assert missing.empty == "None was made."
    bare = SimpleNamespace(title="", numbers=())
    assert [part.name for part in parts_of(registry, bare, {})] == ["missing"]


def test_rows_of_checks_stand_below_what_they_concern():
    rows = (("Fit", "a", Level("pass")), ("Fit", "b", Level("warn")), ("Files", "c", Level("fail")))
    table = TextTable("Status", ("Group", "Check", "Status"), rows, grouped=True)
    assert table.of_checks
    assert [(name, [row[0] for row in of]) for name, of in table.groups] == [
        ("Fit", ["a", "b"]),
        ("Files", ["c"]),
    ]
