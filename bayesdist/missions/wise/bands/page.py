"""The page of several bands: one HTML file that needs nothing else."""

from __future__ import annotations

from pathlib import Path

from bayesdist.files import atomic_path

# importing them registers what the page shows
from bayesdist.missions.wise.bands import curves, figures, findings, tables  # noqa: F401
from bayesdist.missions.wise.bands.context import BANDS, BandsInput
from bayesdist.report.drawing import draw_all, save_drawings
from bayesdist.report.page import parts_of, template

__all__ = ["write_bands"]


def write_bands(folder: Path, inputs: BandsInput) -> list[str]:
    """Names of bands.html and its figures, once they are written into a folder.

    InputError when a file cannot be written.
    """
    drawings = draw_all(BANDS, inputs, pdf=True)
    paths = save_drawings(drawings, folder / "figures")
    overview, *parts = parts_of(BANDS, inputs, drawings)
    page = template("bands.html.jinja", __package__)
    text = page.render(run=inputs, overview=overview, parts=parts, verdict=findings.verdict(inputs))
    with atomic_path(folder / "bands.html") as temporary:
        temporary.write_text(text, encoding="utf-8")
    return ["bands.html", *(f"figures/{path.name}" for path in paths)]
