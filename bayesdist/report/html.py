"""The report: one HTML file that needs nothing else."""

from __future__ import annotations

import base64
import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass

import jinja2
from matplotlib.figure import Figure

from bayesdist.data.files import atomic_path
from bayesdist.errors import InputError
from bayesdist.report import tables
from bayesdist.report.captions import SECTIONS, Caption, caption
from bayesdist.report.context import ReportInput
from bayesdist.report.figures import DPI, png_bytes
from bayesdist.report.numerals import number
from bayesdist.report.status import status_checks, verdict

__all__ = ["render_report", "write_report"]


@dataclass(frozen=True)
class _Picture:
    name: str
    data: str
    width: float  # inches, at which its letters have the size they were set in
    words: Caption


def render_report(inputs: ReportInput, figures: Mapping[str, Figure]) -> str:
    """The report as text.

    Parameters
    ----------
    inputs : ReportInput
    figures : mapping of str to matplotlib.figure.Figure
        As of `all_figures`.

    Returns
    -------
    str
        A whole HTML document without scripts and without links to other files.

    Raises
    ------
    InputError
        For a figure whose name has no place in the report.
    """
    placed = [name for names in SECTIONS.values() for name in names]
    for name in figures:
        if name not in placed:
            raise InputError(
                f"figure {name!r} has no place in the report",
                do=f"name it one of {', '.join(placed)}",
            )
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("bayesdist.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = lambda v: v if isinstance(v, str) else number(v)
    return environment.get_template("report.html.jinja").render(
        run=inputs,
        verdict=verdict(inputs),
        status=status_checks(inputs),
        pictures={
            section: [_picture(n, figures[n], inputs) for n in names if n in figures]
            for section, names in SECTIONS.items()
        },
        tables={
            "data": tables.data_tables(inputs),
            "fit": tables.fit_tables(inputs),
            "outliers": _present(tables.outlier_table(inputs)),
            "coefficients": tables.coefficient_tables(inputs),
            "maps": (tables.map_table(inputs),),
            "budget": _present(tables.budget_table(inputs)),
            "margins": _present(tables.margin_table(inputs)),
            "provenance": (
                *tables.provenance_tables(inputs),
                *_present(tables.config_table(inputs)),
            ),
        },
    )


def _present(table: tables.TextTable | None) -> tuple[tables.TextTable, ...]:
    return () if table is None else (table,)


def _picture(name: str, figure: Figure, inputs: ReportInput) -> _Picture:
    png = png_bytes(figure)
    (pixels,) = struct.unpack(">I", png[16:20])  # width, in the first chunk of every PNG file
    data = base64.b64encode(png).decode("ascii")
    return _Picture(name, data, pixels / DPI, caption(name, inputs))


def write_report(
    path: str | os.PathLike[str], inputs: ReportInput, figures: Mapping[str, Figure]
) -> None:
    """Write the report.

    Parameters
    ----------
    path : path-like
    inputs : ReportInput
    figures : mapping of str to matplotlib.figure.Figure
        As of `all_figures`.

    Raises
    ------
    InputError
        When the file cannot be written, or as `render_report`.
    """
    text = render_report(inputs, figures)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
