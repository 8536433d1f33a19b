"""Runs, figures and pages that several tests look at; each is made once."""

from __future__ import annotations

import shutil

import pytest

from bayesdist.report.run_report import render_report

from .campaigns import campaign_run
from .plots import drawings_of, plots_of
from .runs import SketchedRun, report_run


@pytest.fixture(scope="session")
def converged() -> SketchedRun:
    return report_run()


@pytest.fixture(scope="session")
def not_converged() -> SketchedRun:
    return report_run(converged=False)


@pytest.fixture(scope="session")
def plots(converged):
    return plots_of(converged)


@pytest.fixture(scope="session")
def figures(plots):
    return {name: plot.figure for name, plot in plots.items()}


@pytest.fixture(scope="session")
def drawings(plots):
    """Specks with the words of the figures; other files of this folder look at pictures."""
    return drawings_of(plots)


@pytest.fixture(scope="session")
def campaign_plots():
    return plots_of(campaign_run())


@pytest.fixture(scope="session")
def page(converged, drawings) -> str:
    return render_report(converged, drawings)


@pytest.fixture(scope="session")
def bad_page(not_converged, drawings) -> str:
    # the pictures are those of the other run: only the words are looked at
    return render_report(not_converged, drawings)


OPTIONS = (
    "--headless=new --no-sandbox --disable-gpu --no-first-run --disable-background-networking"
    " --disable-component-update --disable-sync --disable-dev-shm-usage"
).split()


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """Chromium without a window, with its log and what it asks for."""
    selenium = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    driver = shutil.which("chromedriver")
    if not chromium or not driver:
        pytest.skip("there is no chromium with its driver")
    options = selenium.ChromeOptions()
    options.binary_location = chromium
    for one in (*OPTIONS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(one)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    found = selenium.Chrome(options=options, service=selenium.ChromeService(driver))
    found.get("about:blank")
    found.get_log("performance")  # what the browser's own first page asked for
    yield found
    found.quit()
