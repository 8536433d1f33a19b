"""The page in a browser: what its script computes equals the assessment, and nothing else is asked.

Truth is `place_budget` and the rows of `budget.ecsv`, which know nothing of the page.
"""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest

from bayesdist.assess import UserTerm
from bayesdist.assess.budget import budget_of, place_budget
from bayesdist.assess.budget_surface import budget_surface
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.model import error_model
from bayesdist.assess.terms.correlated import LocalErrors
from bayesdist.assess.terms.forms import PRODUCT, Known, Row
from bayesdist.assess.terms.given import Centroids
from bayesdist.assess.terms.parameters import ScaleError
from bayesdist.data.magnitude_errors import estimate
from bayesdist.report.run_report import write_report
from tests.budgets import Curvature, detector_budget

from .plots import drawings_of, plots_of
from .runs import TERMS, report_run

GRID, DRAWS, SCALE = (9, 7), 400, 2757.0
YEARS = (2009.5, 2020.5)


@pytest.fixture(scope="module")
def asked():
    """A run of two chips that drifts, the draws behind its budget, and that budget."""
    run = report_run(size=(4096.0, 2048.0), names=("WFC2", "WFC1"))
    solution, rng = run.solution, np.random.default_rng(4)
    local = {c.number: rng.uniform(0.001, 0.01, (*GRID[::-1], 2)) for c in run.model.chips}
    terms = (
        ScaleError("aberration", "scale", 2e-6, solution, "a paper"),
        Curvature(solution, 1e-4),
        LocalErrors.on_grid("look-up tables", local, solution.model),
        *TERMS,
        UserTerm("background", "random", 0.003, 0.006),
        file_term("sip.hdr, forward", "its numbers"),
    )
    mag, residual = (
        a[run.diagnostics.sample.used]
        for a in (run.diagnostics.sample.table.mag, run.diagnostics.sample.fit_residual)
    )
    centroids = Centroids(estimate(mag, *residual.T))
    model = error_model(solution, terms=(*terms, centroids), pixel_scale=SCALE)
    errors = model.drawn(DRAWS, np.random.default_rng(9))
    budget = detector_budget(
        solution,
        terms=terms,
        epoch=2010.3,
        rng=np.random.default_rng(9),
        grid=GRID,
        n_draws=DRAWS,
        pixel_scale=SCALE,
    )
    surface = budget_surface(errors, GRID, epoch=2010.3, years=YEARS)
    run = run.having(budget=budget, surface=surface)
    return SimpleNamespace(run=run, errors=errors, budget=budget)


def file_term(name: str, source: str) -> Known:
    return Known(Row(name, PRODUCT, source, in_total=False), plane)


def plane(x, y, chip, epoch):
    """What a file is off by: bilinear in the pixel and linear in time, as the page has it."""
    drift = 1e-6 * (epoch - 1990.0) * (x + 3000.0)
    return np.stack([drift, (-1) ** chip * 1e-5 * (y + 500.0)], axis=-1)


@pytest.fixture(scope="module")
def opened(asked, browser, tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "report.html"
    write_report(path, asked.run, drawings_of(plots_of(asked.run, "margins")))
    browser.get(path.as_uri())
    return browser


def requests(browser) -> list[str]:
    return [
        found
        for entry in browser.get_log("performance")
        for found in re.findall(r'"method":"Network.requestWillBeSent".*?"url":"(.*?)"',
                                entry["message"])
    ]  # fmt: skip


def put(browser, **values):
    """Set controls by their names, as a person does, in the order given."""
    for name, value in values.items():
        browser.execute_script(
            "const e = document.getElementById('budget-' + arguments[0]);"
            "e.value = arguments[1];"
            "for (const n of ['input', 'change']) e.dispatchEvent(new Event(n, {bubbles: true}));",
            name.rstrip("_"),
            str(value),
        )


def shown(browser) -> dict[str, tuple[str, ...]]:
    """Texts of u, v and per axis by term."""
    rows = browser.execute_script(
        "return [...document.querySelectorAll('#budget-explorer tbody tr')]"
        ".map(r => [...r.cells].map(c => c.textContent))"
    )
    return {name: tuple(cells[:3]) for name, *cells in rows}


def _sizes(row) -> tuple[float, float, float]:
    """Errors in u, in v, and per axis."""
    return row["u"], row["v"], row["radial"] / np.sqrt(2)


def _number(digits: str, power: str | None) -> float:
    """Number that is written as digits and a power of ten, if any."""
    exponents = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    return float(f"{digits}e{(power or '0').translate(exponents)}")


def agree(text: str, value: float) -> bool:
    """Whether a text of three digits in pixels is the value, and its mas are too."""
    if value == 0:
        return text == "0\u202fpix (0\u202fmas)"
    number = r"([\d.]+)(?:×10([⁻⁰-⁹¹²³]+))?"
    found = re.fullmatch(rf"{number}pix \({number}(mas|µas|arcsec)\)", text.replace("\u202f", ""))
    assert found, text
    unit = {"mas": 1.0, "µas": 1e-3, "arcsec": 1e3}[found[5]]
    found = (_number(*found.group(1, 2)), _number(*found.group(3, 4)) * unit)
    # half of the third digit, and the rounding of the numbers in the page
    return all(
        abs(f - v) <= 0.5001 * 10 ** (np.floor(np.log10(v)) - 2) + 1e-5 * v
        for f, v in zip(found, (value, value * SCALE), strict=True)
    )


def test_at_first_it_is_the_table_of_the_budget(asked, opened):
    """All terms and the total, averaged over both chips at the budget's epoch."""
    found = shown(opened)
    for row in asked.budget.rows():
        texts = found[row["name"]]
        assert all(agree(t, size) for t, size in zip(texts, _sizes(row), strict=True)), (
            row,
            texts,
        )
    extra = set(found) - {r["name"] for r in asked.budget.rows()}
    assert extra <= {"correlation of the parts"}


@pytest.mark.parametrize(
    ("chip", "x", "y", "epoch", "magnitude"),
    [
        (0, 1.0, 1.0, 2010.3, None),
        (0, 1500.0, 700.5, 2015.0, None),
        (1, 4096.0, 3.25, 2020.5, 13.0),
        (1, 700.0, 1999.0, 2009.5, 15.2),
        (0, 3333.0, 444.0, 2012.55, 15.5),
    ],
)
def test_a_position_is_that_of_the_assessment(asked, opened, chip, x, y, epoch, magnitude):
    mag = "" if magnitude is None else magnitude
    put(opened, mode="one", chip=chip, ax=x, ay=y, epoch=epoch, mag=mag)
    truth = place_budget(
        asked.errors,
        x,
        y,
        chip=chip + 1,
        epoch=slider(opened),
        magnitude=magnitude,
    )
    assert slider(opened) == pytest.approx(epoch, abs=0.026)  # the slider's steps
    found = shown(opened)
    assert [t.name for t in truth.every if t.name not in found] == []
    for term in truth.every:
        values = (term.u[0], term.v[0], term.radial[0] / np.sqrt(2))
        assert all(map(agree, found[term.name], values)), (term.name, found[term.name], values)


@pytest.mark.parametrize("epoch", [2009.5, 2010.3, 2012.0, 2016.4, 2020.5])
def test_the_rms_and_a_difference_at_any_epoch_are_those_of_the_assessment(asked, opened, epoch):
    put(opened, mode="rms", epoch=epoch, mag="")
    at = EvaluationDomain.of_chips(asked.run.solution.model, GRID, epoch=slider(opened))
    found = shown(opened)
    for row in budget_of(asked.errors, at).rows():
        if row["name"] in found:
            assert all(map(agree, found[row["name"]], _sizes(row))), (
                _sizes(row),
                found[row["name"]],
            )
    put(opened, mode="two", chip=0, ax=100, ay=200, bx=3000.5, by=1500)
    pixels = [100.0, 3000.5], [200.0, 1500.0]
    truth = place_budget(asked.errors, *pixels, chip=1, epoch=slider(opened), relative=True)
    found = shown(opened)
    for term in truth.every:
        values = (term.u[0], term.v[0], term.radial[0] / np.sqrt(2))
        assert all(map(agree, found[term.name], values)), (term.name, found[term.name], values)


def control(browser, name) -> float:
    script = "return document.getElementById('budget-' + arguments[0]).value"
    return float(browser.execute_script(script, name))


def slider(browser) -> float:
    return control(browser, "epoch")


def test_the_difference_of_two_positions_is_that_of_the_assessment(asked, opened):
    put(opened, mode="two", chip=1, epoch=2018.0, mag=14.0, ax=100, ay=200, bx=3000.5, by=1500)
    truth = place_budget(
        asked.errors,
        [100.0, 3000.5],
        [200.0, 1500.0],
        chip=2,
        epoch=slider(opened),
        magnitude=14.0,
        relative=True,
    )
    found = shown(opened)
    for term in truth.every:
        values = (term.u[0], term.v[0], term.radial[0] / np.sqrt(2))
        assert all(map(agree, found[term.name], values)), (term.name, found[term.name], values)
    # what both positions share: the frames of this run are shifts
    assert [t.name for t in truth.every if t.radial[0] == 0] == [
        "exposure frame",
        "reference catalogue",
    ]


def test_the_slider_and_the_button_change_the_numbers(asked, opened):
    put(opened, mode="rms", mag="", epoch=2010.3)
    early = shown(opened)
    put(opened, epoch=2020.5)
    late = shown(opened)
    assert early["time dependence"] != late["time dependence"]
    assert early["coefficients"] == late["coefficients"]  # at the zero point of the drift
    opened.find_element("xpath", "//button[text()='As in the table']").click()
    total = asked.budget.rows()[-1]
    assert agree(shown(opened)["total"][2], total["radial"] / np.sqrt(2))


def test_keys_and_clicks_choose_a_position(opened):
    from selenium.webdriver.common.keys import Keys

    chip = opened.find_elements("css selector", "#budget-explorer .chip")[0]
    opened.execute_script("arguments[0].scrollIntoView({block: 'center'})", chip)
    chip.click()  # its middle
    place = [control(opened, f"a{axis}") for axis in "xy"]
    assert place == pytest.approx([2048.5, 1024.5], abs=25)  # a pixel of the screen is some twelve
    chip.send_keys(Keys.ARROW_RIGHT)
    moved = control(opened, "ax")
    assert moved - place[0] == pytest.approx(41, abs=1)  # a hundredth of the chip
    assert "pixel" in opened.find_element("css selector", "[aria-live]").text


def test_tables_sort_by_value_and_keep_the_total_below(opened):
    table = opened.find_element("css selector", "#budget table.grid")
    # the last column is how well each is known
    radial = table.find_elements("css selector", "thead th")[-2]

    def column():
        rows = opened.execute_script(
            "return [...arguments[0].tBodies[0].rows].map(r =>"
            " [r.cells[0].textContent, r.cells[r.cells.length - 2].textContent])",
            table,
        )
        return [(n, float(t.split("\u202f")[0])) for n, t in rows]

    before = column()
    for order, sign in (("ascending", 1), ("descending", -1)):
        opened.execute_script("arguments[0].querySelector('button').click()", radial)
        assert radial.get_attribute("aria-sort") == order
        values = [sign * v for n, v in column() if n != "total"]
        assert values == sorted(values)
        assert {n for n, _ in column()[-3:]} == {"total"}
    assert sorted(before) == sorted(column())
    assert len(before) > 6


def test_signs_and_powers_of_ten_sort_as_numbers(opened):
    texts = [
        "−2.5",
        "3.1 × 10⁻⁶",
        "0.002",
        "12\u202f345",
        "999 µas",
        "1.2 arcsec",
        "–",
        "∞",
        "4 mas",
    ]
    worth = opened.execute_script("return arguments[0].map(t => [worth(t)].map(String)[0])", texts)
    expected = [-2.5, 3.1e-6, 0.002, 12345.0, 0.999, 1200.0, np.nan, np.inf, 4.0]
    found = [float(w.replace("Infinity", "inf")) for w in worth]
    np.testing.assert_allclose(found, expected)


def test_a_pointer_reads_the_maps(asked, opened):
    """At a point of the grid the reading is the map's own value."""
    best = asked.run.evaluation.maps[0]
    opened.execute_script(
        "const s = document.getElementById('map-layer'); s.value = arguments[0];"
        "s.dispatchEvent(new Event('change'));", "1")  # fmt: skip
    reading = opened.execute_script(
        "const c = document.querySelector('#map-reader .chip'), b = c.getBoundingClientRect();"
        "c.dispatchEvent(new PointerEvent('pointermove',"
        " {clientX: b.left + 0.01, clientY: b.bottom - 0.01}));"
        "return document.querySelector('#map-reader .reading').textContent")  # fmt: skip
    where, value = reading.split(": ")
    assert where == "pixel (1, 1) of WFC2"
    assert agree(value, best.radius[0, 0] / np.sqrt(2))


@pytest.mark.parametrize("width", [390, 1440])
def test_the_page_is_as_wide_as_the_screen(opened, width):
    opened.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False},
    )
    wide = opened.execute_script("return document.documentElement.scrollWidth")
    opened.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert wide <= width


@pytest.fixture
def wide(asked, opened, tmp_path):
    """A page of its own whose numbers are as long as any: daggers, two chips, names of files."""
    bad = report_run(size=(4096.0, 2048.0), names=("WFC2", "WFC1"), converged=False)
    long = "0461802ej_idc.fits, 0461802ej_d2i.fits, 0461802ej_npl.fits, forward"
    terms = (*TERMS, file_term(long, "the file as it was read back"))
    options = {"terms": terms, "grid": GRID, "n_draws": DRAWS, "pixel_scale": SCALE}
    rng = np.random.default_rng(1)
    budget = detector_budget(bad.solution, epoch=2010.3, rng=rng, **options)
    write_report(tmp_path / "report.html", bad.having(budget=budget), {})
    before = opened.current_window_handle
    opened.switch_to.new_window("tab")
    opened.get((tmp_path / "report.html").as_uri())
    yield opened
    opened.close()
    opened.switch_to.window(before)


def edges(browser, width, cells):
    """Right ends of what these selectors find, in pixels of a screen of that width."""
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False},
    )
    return browser.execute_script(
        "return [...document.querySelectorAll(arguments[0])]"
        ".map(c => c.getBoundingClientRect()).filter(b => b.width).map(b => b.right)",
        cells,
    )


def test_verdicts_and_totals_are_on_the_screen_of_a_phone(wide):
    for cells, least in (
        ("#status .mark", 10),
        ("#margins tbody td:last-child", 3),
        ("#budget table.grid tbody td", 100),
        ("#products tbody td", 8),
    ):
        right = edges(wide, 390, cells)
        assert len(right) >= least and max(right) <= 390, (cells, right)


def test_no_table_is_cut_on_a_screen_of_a_desk(wide):
    edges(wide, 1440, "table")
    cut = wide.execute_script(
        "return [...document.querySelectorAll('.tablebox')]"
        ".filter(b => b.scrollWidth > b.clientWidth).map(b => b.textContent.slice(0, 60))"
    )
    assert cut == []
    total = wide.find_elements("css selector", "#budget table.grid tr.total")[0]
    assert total.find_elements("tag name", "td")[-1].is_displayed()


def test_figures_keep_their_size_on_the_screen_of_a_phone(opened):
    """Their letters could not be read if they were shrunk: what is too wide scrolls in its box."""
    edges(opened, 390, "figure")
    drawn, box, page, overflow = opened.execute_script(
        "const i = document.querySelector('figure img');"
        "i.style.setProperty('--width', '8in');"  # the tests' pictures are specks
        "const b = i.parentElement, found = [i.clientWidth, b.clientWidth,"
        " document.documentElement.scrollWidth, getComputedStyle(b).overflowX];"
        "i.style.removeProperty('--width'); return found;"
    )
    opened.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert drawn == pytest.approx(8 * 96, abs=1)
    assert box <= page <= 390 and overflow == "auto"


def test_captions_stay_on_the_screen_of_a_phone(wide):
    """A table that is wider than the screen scrolls, and its caption does not."""
    right = edges(wide, 390, "main caption")
    assert len(right) > 10 and max(right) <= 390


def test_heads_are_without_buttons_on_paper(opened):
    """Chromium does not repeat a head with a button's box in it on the next page."""
    boxes = (
        "return [...document.querySelectorAll('thead button')]"
        ".filter(b => b.getClientRects().length).length"
    )
    assert opened.execute_script(boxes) > 20
    opened.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    on_paper = opened.execute_script(boxes)
    opened.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    assert on_paper == 0


def test_letters_on_paper_have_seven_points(wide):
    """A page wider than the paper would be shrunk by the browser, with all its letters."""
    text_width = (210 - 2 * 15) / 25.4 * 96
    wide.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    edges(wide, int(text_width), "body")
    widest, smallest, letters = wide.execute_script(
        "const seen = [...document.querySelectorAll('body *')]"
        ".filter(e => e.getClientRects().length && [...e.childNodes]"
        ".some(n => n.nodeType === 3 && n.textContent.trim()));"
        "return [document.documentElement.scrollWidth,"
        " Math.min(...seen.map(e => parseFloat(getComputedStyle(e).fontSize))), seen.length];"
    )
    wide.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    wide.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert letters > 200
    assert widest <= text_width
    assert smallest >= 7 / 72 * 96 - 0.01


def test_every_printed_page_can_be_traced(opened):
    """The line at its foot is one that the browser knows: it takes it up as it was written."""
    rules = opened.execute_script(
        "return [...document.styleSheets].flatMap(s => [...s.cssRules])"
        ".filter(r => r instanceof CSSPageRule).map(r => r.cssText).join(' ')"
    )
    assert "@bottom-left" in rules and "wise-w2 · bayesdist 0.1.0" in rules


def test_no_error_is_logged_and_nothing_leaves_the_page(opened):
    """Last, after all that was done above, and from the first moment on."""
    opened.refresh()
    assert opened.get_log("browser") == []
    asked = requests(opened)
    assert asked and all(url.startswith(("file:", "data:")) for url in asked)


def test_a_table_is_downloaded_as_it_is_shown(opened):
    """As CSV its cells, with plain signs; as LaTeX nothing that TeX would take for a command."""
    import csv
    import io

    shown, text, latex = opened.execute_script(
        "const t = document.querySelector('#margins table');"
        "const rows = [...t.rows].map(r => [...r.cells].map(c => c.textContent.trim()));"
        "return [rows, csvOf(textsOf(t)), latexOf(textsOf(t), 'a & b_c')];"
    )
    rows = list(csv.reader(io.StringIO(text, newline="")))
    tidy = {"\N{MINUS SIGN}": "-", "\u202f": " ", "\xa0": " "}
    assert rows == [
        [" ".join("".join(tidy.get(c, c) for c in cell).split()) for cell in row] for row in shown
    ]
    assert "\\caption{a \\& b\\_c}" in latex
    body = latex.partition("\\hline\n")[2].partition("\\end{tabular}")[0]
    assert not re.search(r"(?<!\\)[%#_]", body)
    assert body.count("\\\\") == len(rows)
    columns = {len(re.findall(r"(?<!\\)&", line)) for line in body.splitlines() if "&" in line}
    assert columns == {len(rows[0]) - 1}


def test_downloads_are_offered_in_the_caption_of_each_table(opened):
    buttons = opened.find_elements("xpath", "//section[@id='margins']//caption/span/button")
    assert {one.text for one in buttons} == {"CSV", "LaTeX"}
