"""Pages that show names of others: nothing in them runs, and nothing is asked of anybody.

What a browser does with a page is looked at in one.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import time
from dataclasses import replace

import numpy as np
import pytest
from lxml import html as lxml_html

from bayesdist.assess import Requirement, UserTerm
from bayesdist.assess.budget_surface import budget_surface
from bayesdist.assess.model import error_model
from bayesdist.report.run_report import OverviewRow, render_report, write_overview, write_report
from bayesdist.utils.checks import Check
from tests.budgets import detector_budget

from .runs import report_run, written

# each ends what it may stand in, and says so if it runs
HOSTILE = (
    "</script><script>window.ran = 1</script>",
    "<!--<script>window.ran = 2</script>",
    "'\"><img src=x onerror='window.ran = 3'>",
    "</style><svg onload=window.ran=4>",
    "]]>--></title><script>window.ran = 5</script>",
    "{{ 7 * 7 }}${window.ran = 6}\u2028",
)
SCRIPT, COMMENT, QUOTE, STYLE, TITLE, TEMPLATE = HOSTILE


@pytest.fixture(scope="module")
def hostile():
    """A run whose chips, terms, requirements, exposures, files and settings have such names."""
    run = report_run(size=(400.0, 200.0), names=(SCRIPT, COMMENT))
    terms = tuple(UserTerm(name, "random", 0.003, 0.006, source=name) for name in HOSTILE)
    errors = error_model(run.solution, terms=terms, pixel_scale=2757.0)
    drawn = errors.drawn(200, np.random.default_rng(9))
    budget = detector_budget(
        run.solution,
        terms=terms,
        epoch=2010.3,
        rng=np.random.default_rng(9),
        grid=(5, 4),
        n_draws=200,
        pixel_scale=2757.0,
    )
    named = Requirement(QUOTE, "p95", 1.0, unit="pix", probability=0.95)
    names = (*HOSTILE[: len(run.diagnostics.sample.table.exposure_names)],)
    table = replace(
        run.diagnostics.sample.table,
        sources=(STYLE,),
        exposure_names=names,
        rejected={COMMENT: 3, SCRIPT: 1},
    )
    return run.having(
        title=TITLE,
        configuration={"data": {"matches": SCRIPT, COMMENT: QUOTE}, "detector": {"name": STYLE}},
        sample=replace(run.diagnostics.sample, table=table),
        budget=budget,
        surface=budget_surface(drawn, (5, 4), epoch=2010.3, years=(2009.5, 2012.5)),
        margins=tuple(replace(m, requirement=named) for m in run.evaluation.margins),
        checks=(*run.evaluation.checks, Check(QUOTE, STYLE, TITLE, TEMPLATE, "warn")),
        summary={"products": [written(SCRIPT, COMMENT, f"warning: {TITLE}")]},
        provenance={"command": SCRIPT, "inputs": {COMMENT: QUOTE}, "versions": {STYLE: TITLE}},
    )


@pytest.fixture(scope="module")
def page(hostile, drawings) -> str:
    return render_report(hostile, {"margins": drawings["margins"]})


def policy_of(page: str) -> dict[str, list[str]]:
    """Sources that a page allows, by directive."""
    [text] = lxml_html.fromstring(page).xpath(
        "//meta[@http-equiv='Content-Security-Policy']/@content"
    )
    return {name: sources for name, *sources in (one.split() for one in text.split(";"))}


def hash_of(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def rows_of_overview() -> list[OverviewRow]:
    row = OverviewRow(
        name=SCRIPT, link="javascript%3Aalert(1)", detector=COMMENT, simulated=True, level="pass",
        headline=QUOTE, worst_margin=12.3, worst_requirement=STYLE, valid_until=2020.3,
        open_ended=True, epoch=2010.3, uncertainty=TITLE, n_used=1234, chi2_per_dof=1.02,
        began=TEMPLATE,
    )  # fmt: skip
    return [row, replace(row, name="b", level="fail", worst_margin=-4.0)]


def test_a_page_allows_its_own_style_and_script_and_nothing_else(page, tmp_path):
    write_overview(tmp_path / "all.html", rows_of_overview())
    for text in (page, (tmp_path / "all.html").read_text(encoding="utf-8")):
        policy = policy_of(text)
        assert policy["default-src"] == policy["base-uri"] == policy["form-action"] == ["'none'"]
        assert policy["img-src"] == ["data:"]
        # as a browser takes them apart: what stands between the tags
        for tag in ("style", "script"):
            [content] = re.findall(f"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
            assert policy[f"{tag}-src"] == [hash_of(content)]
        tree = lxml_html.fromstring(text)
        assert not tree.xpath("//@style | //@*[starts-with(name(), 'on')]")
        # before anything that it is to hold for
        assert text.index("Content-Security-Policy") < text.index("<style")


def test_names_are_shown_as_they_are(page, hostile):
    """In the page, and in what its script reads."""
    tree = lxml_html.fromstring(page)
    assert tree.xpath("//h1")[0].text_content() == TITLE
    heads = {" ".join(e.text_content().split()) for e in tree.xpath("//th | //td")}
    for name in HOSTILE:
        assert " ".join(name.split()) in heads
    kinds = [one.get("type") for one in tree.xpath("//script")]
    assert kinds == ["application/json", "application/json", None]
    assert not tree.xpath("//svg | //img[@onerror] | //comment()")
    data = json.loads(tree.xpath("//script[@id='budget-data']")[0].text)
    assert [chip["name"] for chip in data["chips"]] == [SCRIPT, COMMENT]
    assert {row["name"] for row in data["given"]} == set(HOSTILE)


@pytest.fixture(scope="module")
def opened(browser, hostile, drawings, tmp_path_factory):
    path = tmp_path_factory.mktemp("hostile") / "report.html"
    write_report(path, hostile, {"margins": drawings["margins"]})
    browser.get_log("browser")
    browser.get(path.as_uri())
    return browser


def ran(browser):
    return browser.execute_script("return window.ran ?? null")


def test_nothing_runs_while_the_budget_is_asked(opened):
    """All controls of the page are used: names go through lists, titles and tables."""
    opened.execute_script(
        "const put = (id, value) => { const e = document.getElementById(id); e.value = value;"
        " e.dispatchEvent(new Event('change')); };"
        "put('budget-mode', 'two'); put('budget-chip', 1); put('budget-ax', 20);"
        "put('budget-map', arguments[0]);"
        "put('map-layer', 1);",
        SCRIPT,
    )
    rows = opened.execute_script(
        "return [...document.querySelectorAll('#budget-explorer tbody th')].map(c => c.textContent)"
    )
    assert set(HOSTILE) <= set(rows)
    widths = opened.execute_script(
        "return [...document.querySelectorAll('#budget-explorer .stack span')]"
        ".map(e => e.getBoundingClientRect().width)"
    )
    assert len(widths) > len(HOSTILE) and min(widths) > 0  # the bar has its pieces
    for head in opened.find_elements("css selector", "#budget table.grid thead button"):
        opened.execute_script("arguments[0].click()", head)
    assert ran(opened) is None
    assert opened.get_log("browser") == []


def test_pictures_have_the_width_that_they_were_drawn_for(opened):
    [(width, expected)] = opened.execute_script(
        "return [...document.querySelectorAll('figure img')].map(e => [e.style.cssText ||"
        " getComputedStyle(e).width,"
        " Number(e.closest('figure').className.match(/width-(\\d+)/)[1]) * 0.96])"
    )
    assert float(width.removesuffix("px")) == pytest.approx(expected, abs=0.1)


def test_tables_are_saved(opened, tmp_path):
    opened.execute_cdp_cmd(
        "Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)}
    )
    button = opened.find_element("xpath", "//section[@id='margins']//button[text()='CSV']")
    opened.execute_script("arguments[0].click()", button)
    for _ in range(100):
        if found := list(tmp_path.glob("*.csv")):
            break
        time.sleep(0.1)
    [saved] = found
    assert "onerror" in saved.read_text(encoding="utf-8")  # the name of the requirement, as it is


def test_what_got_into_a_page_in_spite_of_all_does_not_run(browser, page, tmp_path):
    """The policy is the second wall: scripts, handlers, styles and addresses of others."""
    bad = (
        "<script>window.ran = 7</script><img src='http://localhost:9/x.png'"
        " onerror='window.ran = 8'><h2 style='color: rgb(1, 2, 3)' id='bad'>x</h2>"
        "<base href='http://localhost:9/'><iframe src='data:text/html,x'></iframe>"
    )
    path = tmp_path / "report.html"
    path.write_text(page.replace("<main>", f"<main>{bad}"), encoding="utf-8")
    browser.get_log("browser")
    browser.get_log("performance")
    browser.get(path.as_uri())
    assert ran(browser) is None
    color = "return getComputedStyle(document.getElementById('bad')).color"
    assert browser.execute_script(color) != "rgb(1, 2, 3)"
    assert browser.execute_script("return document.baseURI") == path.as_uri()
    refusals = " ".join(one["message"] for one in browser.get_log("browser"))
    for directive in ("script-src", "img-src", "style-src", "base-uri"):
        assert directive in refusals
    # its own script works beside that
    assert browser.execute_script("return !document.getElementById('budget-explorer').hidden")


def test_the_page_of_many_runs_sorts(browser, tmp_path):
    write_overview(tmp_path / "all.html", rows_of_overview())
    browser.get_log("browser")
    browser.get((tmp_path / "all.html").as_uri())
    names = "return [...document.querySelectorAll('tbody th')].map(c => c.firstChild.textContent)"
    assert browser.execute_script(names) == ["b", SCRIPT]
    head = browser.find_element("xpath", "//th//button[starts-with(text(), 'Worst margin')]")
    for expected in (["b", SCRIPT], [SCRIPT, "b"]):  # by margin, rising and falling
        browser.execute_script("arguments[0].click()", head)
        assert browser.execute_script(names) == expected
    assert ran(browser) is None and browser.get_log("browser") == []
