"""The page of several bands: one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from bayesdist.data.files import atomic_path
from bayesdist.report.bands import findings, tables
from bayesdist.report.bands.captions import SECTIONS, caption
from bayesdist.report.bands.context import BandsInput
from bayesdist.report.page import picture_of, template
from bayesdist.report.tables.text import TextTable, listing

__all__ = ["render_bands", "write_bands"]

TITLES = {
    "vectors": "Distortion",
    "histograms": "Residuals with and without calibration",
    "tables": "Residuals in bins",
    "structure": "Structure left in the residuals",
    "formal": "Formal uncertainties",
    "coverage": "Coverage",
    "provenance": "Provenance",
}


def render_bands(inputs: BandsInput, images: Mapping[str, bytes]) -> str:
    """The page as text.

    Parameters
    ----------
    inputs : BandsInput
    images : mapping of str to bytes
        PNG files by name, as of `drawn`.

    Returns
    -------
    str
        A whole HTML document without scripts and without links to other files.
    """
    return template("bands.html.jinja").render(
        run=inputs,
        titles=TITLES,
        overview=findings.overview_table(inputs),
        tables={name: [t for t in several if t] for name, several in _tables(inputs).items()},
        pictures={
            section: [picture_of(n, images[n], caption(n, inputs)) for n in names if n in images]
            for section, names in SECTIONS.items()
        },
    )


def _tables(inputs: BandsInput) -> dict[str, list[TextTable | None]]:
    return {
        "vectors": [findings.vector_table(inputs)],
        "histograms": [findings.histogram_table(inputs)],
        "tables": [*tables.tables_of(inputs), tables.contradiction_table(inputs)],
        "structure": [findings.structure_table(inputs)],
        "formal": [findings.formal_table(inputs)],
        "coverage": [findings.coverage_table(inputs)],
        "provenance": [listing("", {k: str(v) for k, v in inputs.provenance.items()})],
    }


def write_bands(path: Path, inputs: BandsInput, images: Mapping[str, bytes]) -> None:
    """Write the page.

    Parameters
    ----------
    path : pathlib.Path
    inputs : BandsInput
    images : mapping of str to bytes

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    text = render_bands(inputs, images)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
