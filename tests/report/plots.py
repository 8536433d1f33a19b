"""Figures of a run as plots, and as drawings that cost nothing."""

from __future__ import annotations

import io
from functools import cache

from matplotlib.figure import Figure
from PIL import Image

from bayesdist.report.contents import Plot
from bayesdist.report.drawing import Drawing
from bayesdist.report.run import ReportedRun
from bayesdist.report.sections import REPORT


def plots_of(run: ReportedRun, *names: str) -> dict[str, Plot]:
    """Figures with their words, of these names or all."""
    items = REPORT.items(run, "figure")
    return {item.name: item.made(run) for item in items if not names or item.name in names}


def figures_of(run: ReportedRun, *names: str) -> dict[str, Figure]:
    return {name: plot.figure for name, plot in plots_of(run, *names).items()}


def plot_of(run: ReportedRun, name: str) -> Plot:
    return plots_of(run, name)[name]


def tables_of(run: ReportedRun, section: str) -> list:
    """Tables of a section."""
    out = []
    for item in REPORT.items(run, "table"):
        if item.section == section:
            made = item.made(run)
            out += [made] if hasattr(made, "rows") else list(made or ())
    return out


@cache
def _speck() -> bytes:
    page = io.BytesIO()
    Image.new("RGB", (4, 3), "white").save(page, format="png")
    return page.getvalue()


def drawings_of(plots: dict[str, Plot]) -> dict[str, Drawing]:
    """The words of figures, and specks in place of them."""
    return {
        name: Drawing(_speck(), "png", 0.03, None, plot.title, plot.text, plot.alt)
        for name, plot in plots.items()
    }
