"""The page: well formed, complete in itself, honest about what is not converged."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from lxml import html as lxml_html

from bayesdist.diagnose import ScoreTest
from bayesdist.diagnose.checks import structure_checks
from bayesdist.diagnose.residuals.misfit import Misfit
from bayesdist.errors import InputError
from bayesdist.infer.posterior.checks import sampling_checks
from bayesdist.report.run_report import render_report, write_report
from bayesdist.report.sections import REPORT
from bayesdist.report.sections.fit import fit_tables
from bayesdist.report.sections.posterior import coefficient_tables
from bayesdist.report.sections.status import status_checks, verdict

from .runs import report_run, written

VOID = {"meta", "img", "br", "hr", "input", "link"}


class Strict(HTMLParser):
    """Fails where an element is not closed by its own end tag."""

    def __init__(self):
        super().__init__(convert_charrefs=True)
        self.open, self.links, self.tags = [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.links += [v for k, v in attrs if k in ("src", "href", "action", "srcset")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()


def parsed(page: str) -> Strict:
    parser = Strict()
    parser.feed(page)
    parser.close()
    assert not parser.open
    return parser


def words(page: str) -> str:
    """What a reader sees, without the pictures, the style sheet and the script."""
    tree = lxml_html.fromstring(page)
    for hidden in tree.xpath("//style | //script"):
        hidden.getparent().remove(hidden)
    return tree.text_content()


def test_page_is_well_formed(page, bad_page):
    for one in (page, bad_page):
        assert one.lstrip().startswith("<!DOCTYPE html>")
        parsed(one)


def test_page_needs_nothing_else(page):
    parser = parsed(page)
    own = ("data:image/png;base64,", "data:text/csv;charset=utf-8;base64,", "#")
    assert all(link.startswith(own) for link in parser.links)
    assert not {"link", "iframe", "object"} & {tag for tag, _ in parser.tags}
    scripts = [attributes for tag, attributes in parser.tags if tag == "script"]
    assert scripts and not any("src" in s for s in scripts)
    assert not re.search(r"\b(fetch|XMLHttpRequest|import|WebSocket|sendBeacon)\b", page)
    style = re.search(r"<style>(.*?)</style>", page, re.DOTALL).group(1)
    assert "url(" not in style and "@import" not in style
    without_pictures = re.sub(r"base64,[^\"]+", "", page)
    # the name of a vocabulary is no address that is asked, and that of a header none at all
    for known in ('"http://www.w3.org/2000/svg"', 'http-equiv="Content-Security-Policy"'):
        without_pictures = without_pictures.replace(known, "")
    assert "http" not in without_pictures


def test_links_lead_to_sections_in_the_order_of_the_report(page):
    tree = lxml_html.fromstring(page)
    sections = tree.xpath("//section/@id")
    assert sections == ["status", "data", "fit", "residuals", "outliers", "coefficients", "maps",
                        "budget", "margins", "products", "provenance"]  # fmt: skip
    assert [h[1:] for h in tree.xpath("//nav//a/@href")] == sections[1:]


def test_pictures_are_whole_and_described(page, figures):
    images = lxml_html.fromstring(page).xpath("//figure/div/img")
    every = [one for one in REPORT.entries if one.kind == "figure" and one.each is None]
    # periods, held-out stars and no catalogue were not asked for, and nothing depends on time
    others = ("periods", "holdout", "selfcal", "campaign", "previous")
    named = {one.name for one in every if not one.section.startswith(others)}
    assert set(figures) == named - {"validity_period"}
    assert len(images) == len(figures)
    for image in images:
        png = base64.b64decode(image.get("src").split(",", 1)[1], validate=True)
        assert png.startswith(b"\x89PNG") and png.endswith(b"IEND\xaeB`\x82")
        assert len(image.get("alt")) > 20
        caption = image.xpath("ancestor::figure/figcaption")[0].text_content()
        assert caption.strip().endswith(".") and len(caption) > 60


def test_no_nan_is_ever_printed(converged, drawings):
    fit, c = converged.fit, converged.posterior.convergence
    rhat = c.rhat.copy()
    rhat[4] = np.nan
    holes = converged.having(
        fit=replace(fit, dof=0, condition=np.nan),
        posterior=replace(
            converged.posterior,
            convergence=replace(
                c,
                rhat=rhat,
                pareto_k=-np.inf,
                importance_efficiency=np.nan,
                mcse_mean=c.mcse_mean * np.nan,
            ),
        ),
        provenance={"timings": {"fit": float("nan")}, "seed": None, "note": np.float64("nan")},
        summary={"products": [written("a.fits", "a", closure_pix=float("nan"))]},
    )
    assert not re.search(
        r"\b(nan|None|inf)\b", words(render_report(holes, drawings)), re.IGNORECASE
    )


def test_a_page_of_a_good_run_says_nothing_of_provisional(page):
    text = words(page).lower()
    assert "not converged" not in text and "provisional" not in text and "†" not in text


def test_non_convergence_is_loud_and_everywhere(bad_page, not_converged):
    tree = lxml_html.fromstring(bad_page)
    (banner,) = tree.xpath("//*[@role='alert']")
    assert "NOT CONVERGED" in banner.text_content()
    # before anything else that the page says of the run
    assert bad_page.index('role="alert"') < bad_page.index('class="verdict')
    assert not_converged.posterior.convergence.reasons[0] in words(bad_page)
    for heading in tree.xpath("//h2 | //figcaption | //table[not(@class='listing')]/caption"):
        assert "PROVISIONAL" in heading.text_content()


def test_numbers_that_rest_on_the_draws_carry_a_dagger(bad_page):
    tree = lxml_html.fromstring(bad_page)
    for section in ("outliers", "budget", "margins", "coefficients"):
        for table in tree.xpath(f"//section[@id='{section}']//table"):
            heads = [h.text_content().strip() for h in table.xpath(".//thead//th")]
            drawn = {"Mean", "sd", "95 % interval", "Posterior mean", "Value", "Margin", "P(met)",
                     "u", "v", "Per axis", "CE68", "CE95", "68 %", "95 %"}  # fmt: skip
            columns = [k for k, h in enumerate(heads) if h.partition(" [")[0] in drawn]
            assert columns, heads
            for row in table.xpath("./tbody/tr"):
                cells = [c.text_content().strip() for c in row.xpath("./th | ./td")]
                assert all(cells[k] == "–" or cells[k].endswith("†") for k in columns), cells


def test_status_has_each_criterion_with_number_limit_and_outcome(page, converged):
    tree = lxml_html.fromstring(page)
    rows = [
        [c.text_content().strip() for c in r.xpath("./th | ./td")]
        for r in tree.xpath("//section[@id='status']//tbody/tr[not(@class)]")
    ]
    assert all(len(r) == 4 and all(r) for r in rows)
    assert {r[3].split()[1] for r in rows} <= {"pass", "warn", "FAIL"}
    found = {r[0]: r for r in rows}
    rhat = next(r for name, r in found.items() if "R-hat" in name)
    assert float(rhat[1]) == pytest.approx(converged.posterior.convergence.rhat_max, abs=1e-4)
    for margin in converged.evaluation.margins:
        row = next(r for name, r in found.items() if name.startswith(margin.requirement.name))
        assert row[3].endswith(
            {"met": "pass", "missed": "FAIL", "not shown": "warn"}[margin.verdict]
        )


def test_a_copy_on_paper_can_be_traced(converged, drawings):
    """By the line below every page, which is a string of the style sheet, and by the footer."""
    made = {"created": "2026-11-22T10:58:32+00:00", "versions": {"bayesdist": "1.2.3"}}
    run = converged.having(title='a "W2" </style>', provenance=made)
    text = render_report(run, drawings)
    maker = "bayesdist 1.2.3 in a run of 2026-11-22 10:58:32 UTC"
    tree = lxml_html.fromstring(text)
    assert tree.xpath("//footer")[0].text_content().startswith(f"Made by {maker}. ")
    [line] = re.findall(r'@bottom-left { content: "(.*?)"; }', tree.xpath("//style")[0].text)
    said = re.sub(r"\\([0-9a-f]+) ", lambda m: chr(int(m[1], 16)), line)
    assert said == f"{run.title} · {maker}"
    assert "Made by bayesdist. " in render_report(converged.having(provenance={}), drawings)


def test_files_are_named_without_the_folder_that_all_are_in(converged):
    paths = {"/data/a/x.ecsv": "0", "/data/a/lists/y.ecsv": "1"}
    run = converged.having(provenance={"inputs": paths})
    tree = lxml_html.fromstring(render_report(run, {}))
    rows = tree.xpath("//section[@id='provenance']//table[caption='Inputs']//th")
    assert [row.text_content() for row in rows] == ["x.ecsv", "lists/y.ecsv"]


def test_negative_numbers_have_a_minus(page, converged):
    tree = lxml_html.fromstring(page)
    cells = [c.text_content() for c in tree.xpath("//table//td[contains(@class, 'n')]")]
    assert not [text for text in cells if re.search(r"(^|[ (])-", text)]
    missed = next(m for m in converged.evaluation.margins if m.verdict == "missed")
    row = tree.xpath(f"//section[@id='margins']//tr[th='{missed.requirement.name}']")[0]
    assert f"(\N{MINUS SIGN}{abs(missed.percent):.0f}\u202f%)" in row.text_content()


def _only(run, *verdicts):
    return run.having(margins=tuple(m for m in run.evaluation.margins if m.verdict in verdicts))


def test_verdict_in_words(converged, not_converged):
    assert {m.verdict for m in converged.evaluation.margins} == {"met", "missed", "not shown"}
    assert verdict(_only(converged, "met")).level == "pass"
    assert verdict(_only(converged, "met", "not shown")).level == "warn"
    doubted = [replace(m, verdict="undecided") for m in _only(converged, "met").evaluation.margins]
    run = converged.having(margins=(*converged.evaluation.margins, *doubted))
    assert verdict(_only(run, "met", "undecided")).level == "warn"
    assert "is undecided and 1 not shown" in verdict(_only(run, "undecided", "not shown")).headline
    assert verdict(_only(converged, "met", "not shown", "missed")).level == "fail"
    assert verdict(_only(converged)).level == "pass"
    nothing = verdict(_only(converged))
    assert nothing.headline.startswith("No requirement was stated")
    assert "No requirement" not in " ".join(nothing.sentences)  # once is enough
    assert verdict(_only(not_converged)).level == "fail"
    broken = {"products": [written("x.fits", "x", "error: it has no inverse")]}
    assert verdict(_only(converged).having(summary=broken)).level == "fail"


def test_one_limit_missed_is_one_failure(converged):
    c = converged.posterior.convergence
    rhat = c.rhat.copy()
    rhat[5] = 1.02
    worse = replace(c, rhat=rhat, converged=False, reasons=("R-hat of u_0_2 is 1.02",))
    checks = sampling_checks(replace(converged.posterior, convergence=worse))
    failed = [check.name for check in checks if check.level == "fail"]
    assert len(failed) == 2 and "Converged" in failed  # the criterion itself, and the sum of them


def test_structure_in_the_residuals_has_a_row(converged):
    """The verdict of the row is that of the warning, whichever chip it is of."""
    (chip,) = converged.model.chips
    for p, level in ((0.3, "pass"), (2e-4, "pass"), (1e-5, "warn")):
        found = Misfit(p, "columns", 0.0021, "pix", chip)
        assert found.significant == (level == "warn")
        checks = (*converged.evaluation.checks, *structure_checks((found,)))
        *_, row = status_checks(converged.having(checks=checks))["Fit"]
        assert row.name.startswith("Structure in the residuals") and row.level == level
        assert row.value.startswith("0.0021\u202fpix rms in columns of W2, p ")


def test_names_cannot_break_the_page(converged, figures):
    evil = "<script>alert('x')</script> & \"quotes\""
    run = converged.having(
        title=evil,
        configuration={"data": {"matches": evil}},
        sample=replace(
            converged.diagnostics.sample,
            table=replace(
                converged.diagnostics.sample.table,
                sources=(evil,),
                exposure_names=("<b>", "&amp;", "frame2", "frame3"),
                rejected={"<i>reason": 3},
            ),
        ),
        flagged=None,
        fit=converged.fit,
        provenance={"command": evil, "inputs": {evil: "0"}},
        summary={"products": [written(evil, evil, f"note: {evil}")]},
    )
    out = render_report(run, {})
    assert "<script>alert" not in out and "<b>\n" not in out
    parsed(out)
    tree = lxml_html.fromstring(out)
    assert tree.xpath("//h1")[0].text_content() == evil
    assert "&amp;" in [t.text_content() for t in tree.xpath("//section[@id='data']//tbody//th")]


def test_a_page_of_some_stars_says_of_how_many(converged):
    """What is drawn from a sample is marked; what is counted, is counted over all stars."""
    page = render_report(report_run(shown=1500), {})
    text = words(page)
    assert "a sample of 1\u202f500 of 6\u202f000 stars" in text
    whole = words(render_report(converged, {}))
    assert "a sample of" not in whole

    def row(page, head):
        (cells,) = [
            [c.text_content() for c in tr.xpath("./th|./td")]
            for tr in lxml_html.fromstring(page).xpath("//tr")
            if tr.xpath("./th|./td")[0].text_content().strip() == head
        ]
        return cells

    for head in ("Matched stars", "Used by the least-squares fit", "frame0", "frame3"):
        assert row(page, head) == row(render_report(converged, {}), head)


def test_legendre_and_monomial_tables_hold_the_same_polynomial(converged):
    """The two printed forms, read back, put a star at the same place."""
    legendre, _, monomial = coefficient_tables(converged)
    basis = converged.model.basis(1)
    x, y = np.array([200.0, 700.0]), np.array([300.0, 150.0])
    powers = np.stack([(x - 508.5) ** i * (y - 508.5) ** j for i, j in basis.terms], axis=-1)

    def value(text):
        plain = text.translate(str.maketrans("−⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "--0123456789")).replace("\u202f", "")
        return float(plain.replace("×10", "e"))

    for axis in "uv":
        a = [value(r[1]) for r in legendre.rows if r[0].startswith(f"{axis}_")]
        b = [value(r[3]) for r in monomial.rows if r[0] == axis]
        # 15 terms, each rounded to 5 % of a formal error of some 0.005 pixel
        np.testing.assert_allclose(basis.evaluate(x, y) @ a, powers @ b, atol=0.005)


def test_the_file_appears_whole_or_not_at_all(converged, drawings, tmp_path):
    path = tmp_path / "report.html"
    write_report(path, converged, {"margins": drawings["margins"]})
    first = path.read_text(encoding="utf-8")
    assert first.rstrip().endswith("</html>")
    assert {p.name for p in tmp_path.iterdir()} == {"report.html"}
    with pytest.raises(InputError, match="missing"):
        write_report(tmp_path / "missing" / "report.html", converged, {})


def test_tables_of_two_chips_name_them():
    """The worst chip in the verdict; every number of a table belongs to a named chip, or to all."""
    run = report_run(size=(4096.0, 2048.0), names=("WFC2", "WFC1"))
    page = render_report(run, {})
    parsed(page)
    text = words(page)
    worst = max(run.evaluation.maps, key=lambda m: m.radius_max)
    x, y = worst.position_of_max
    (name,) = (chip.name for chip in run.model.chips if chip.number == worst.chip)
    assert f"at pixel ({x:.0f}, {y:.0f}) of {name}" in text
    tree = lxml_html.fromstring(page)
    names = [t.text_content() for t in tree.xpath("//section[@id='maps']//tbody//th")]
    assert names == [
        f"{chip}, {kind}" for chip in ("WFC2", "WFC1") for kind in ("least squares", "posterior")
    ]
    chips = [t.text_content() for t in tree.xpath("//section[@id='budget']//tbody//td[1]")]
    n_parts = sum(term.of_parameters for term in run.evaluation.budget.terms)
    n_rows = (
        len(run.evaluation.budget.rows()) - n_parts + 1
    )  # the parts of the model jointly, then alone
    expected = [c for n in (n_rows, n_parts) for c in ("all", "WFC2", "WFC1") for _ in range(n)]
    assert n_parts > 1 and chips == expected
    for chip in ("WFC1", "WFC2"):
        assert f"Monomial coefficients, chip {chip}:" in text


def test_the_residuals_of_a_table_are_those_of_its_chip():
    run = report_run(size=(4096.0, 2048.0), names=("WFC2", "WFC1"))
    table = next(t for t in fit_tables(run) if "Geometry" not in t.caption and len(t.rows) == 6)
    labels = [row[0] for row in table.rows]
    assert labels == [f"{c}, {a}" for c in ("all", "WFC2", "WFC1") for a in "uv"]
    t = run.diagnostics.sample.table
    for row in table.rows:
        chip, axis = row[0].split(", ")
        here = run.diagnostics.sample.used & (
            np.isin(t.chip, [t.chip_numbers.index(n) for n in NUMBERS[chip]])
        )
        largest = run.diagnostics.sample.fit_residual[here, "uv".index(axis)].max()
        assert float(row[4].replace("\u2212", "-")) == pytest.approx(largest, abs=6e-4)


NUMBERS = {"all": (1, 2), "WFC2": (1,), "WFC1": (2,)}


def test_what_residuals_were_asked_and_verdicts_rest_on_stands_on_the_page(converged):
    common = {"dof": 10.0, "dof_residual": 900.0, "unit": "pix"}
    asked = (
        ScoreTest("order 5", 61.0, p_value=2e-9, size=0.0042, smallest=0.003, significant=True,
                  remedy="raise model.order to 5", finding="The residuals hold it", **common),
        ScoreTest("edges", 9.1, p_value=0.52, size=0.0, smallest=np.inf, significant=False,
                  remedy="leave out the margins", finding="Nothing rises", **common),
        ScoreTest("gap", 0.4, p_value=0.52, size=0.0, smallest=0.003, significant=False,
                  remedy="add terms", finding="No drift", **common | {"unit": "pix/yr"}),
    )  # fmt: skip
    first, *rest = converged.evaluation.margins
    margins = (
        replace(first, rests_on=("a polynomial of order 4", "no held-out stars")),
        *(replace(m, rests_on=("a polynomial of order 4",)) for m in rest),
    )
    tree = lxml_html.fromstring(
        render_report(converged.having(score_tests=asked, margins=margins), {})
    )
    found = tree.xpath("//section[@id='fit']//tr[th='order 5']")[0].text_content()
    assert "2.0 × 10⁻⁹" in found.replace("\u202f", " ") and "found: raise model.order to 5" in found
    assert "nothing found" in tree.xpath("//section[@id='fit']//tr[th='edges']")[0].text_content()
    assert tree.xpath("//section[@id='fit']//tr[th='gap, per year']")
    of_all, of_one = (
        tree.xpath(f"//section[@id='margins']//tr[th='{clause}']/td")[0].text_content()
        for clause in margins[0].rests_on
    )
    assert (of_all, of_one) == ("all", first.requirement.name)


def test_simulated_data_are_named_on_every_page(converged, drawings, page):
    """In a band on the screen, in the title, and in the margin of each page of paper."""
    config = {**converged.configuration, "data": {"simulated": True}}
    text = render_report(converged.having(configuration=config), drawings)
    tree = lxml_html.fromstring(text)
    (band,) = tree.xpath("//p[@class='simulated']")
    assert "SIMULATED" in band.text_content() and "SIMULATED" in tree.xpath("//title")[0].text
    assert '@top-center { content: "SIMULATED DATA"' in text
    assert "SIMULATED" not in page
