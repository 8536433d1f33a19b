"""Runs, figures and pages that several tests look at; each is made once."""

from __future__ import annotations

import pytest

from bayesdist.report import ReportInput, all_figures, drawn
from bayesdist.report.html import render_report

from .runs import report_input


@pytest.fixture(scope="session")
def converged() -> ReportInput:
    return report_input()


@pytest.fixture(scope="session")
def not_converged() -> ReportInput:
    return report_input(converged=False)


@pytest.fixture(scope="session")
def figures(converged):
    return all_figures(converged)


@pytest.fixture(scope="session")
def images(figures):
    return drawn(figures)


@pytest.fixture(scope="session")
def page(converged, images) -> str:
    return render_report(converged, images)


@pytest.fixture(scope="session")
def bad_page(not_converged, images) -> str:
    # the pictures are those of the other run: only the words are looked at
    return render_report(not_converged, images)
