"""Figures of a run as plots, and as drawings that cost nothing."""

from __future__ import annotations

import io
from functools import cache

from matplotlib.figure import Figure
from PIL import Image

from bayesdist.report.contents import Plot
from bayesdist.report.context import ReportInput
from bayesdist.report.drawing import Drawing
from bayesdist.report.sections import REPORT


def plots_of(r: ReportInput, *names: str) -> dict[str, Plot]:
    """Figures with their words, of these names or all."""
    items = REPORT.items(r, "figure")
    return {item.name: item.made(r) for item in items if not names or item.name in names}


def figures_of(r: ReportInput, *names: str) -> dict[str, Figure]:
    return {name: plot.figure for name, plot in plots_of(r, *names).items()}


def plot_of(r: ReportInput, name: str) -> Plot:
    return plots_of(r, name)[name]


def tables_of(r: ReportInput, section: str) -> list:
    """Tables of a section."""
    out = []
    for item in REPORT.items(r, "table"):
        if item.section == section:
            made = item.made(r)
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
