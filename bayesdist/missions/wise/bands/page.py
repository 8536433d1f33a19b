"""The page of several bands: one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from bayesdist.files import atomic_path

# importing them registers what the page shows
from bayesdist.missions.wise.bands import curves, figures, findings, tables  # noqa: F401
from bayesdist.missions.wise.bands.context import BANDS, BandsInput
from bayesdist.report.drawing import Drawing, draw_all
from bayesdist.report.page import parts_of, template

__all__ = ["draw_bands", "render_bands", "write_bands"]


def draw_bands(inputs: BandsInput) -> dict[str, Drawing]:
    """All figures of the page as files, by name, in its order."""
    return draw_all(BANDS, inputs)


def render_bands(inputs: BandsInput, drawings: Mapping[str, Drawing]) -> str:
    """The page as text.

    `drawings`: as of `draw_bands`. Returns a whole HTML document without scripts and without links
    to other files.
    """
    overview, *parts = parts_of(BANDS, inputs, drawings)
    return template("bands.html.jinja").render(run=inputs, overview=overview, parts=parts)


def write_bands(path: Path, inputs: BandsInput, drawings: Mapping[str, Drawing]) -> None:
    """Write the page.

    InputError when the file cannot be written.
    """
    text = render_bands(inputs, drawings)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
