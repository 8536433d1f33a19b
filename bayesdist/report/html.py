"""The report: one HTML file that needs nothing else."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

from bayesdist.data.files import atomic_path
from bayesdist.errors import InputError
from bayesdist.report import tables
from bayesdist.report.campaign import PARTS, CampaignFigure, campaign_tables
from bayesdist.report.captions import SECTIONS, caption
from bayesdist.report.context import ReportInput
from bayesdist.report.figures import plan_of_campaign
from bayesdist.report.page import Picture, picture_of, template
from bayesdist.report.periods import period_tables
from bayesdist.report.status import status_checks, verdict

__all__ = ["render_report", "write_report"]


@dataclass(frozen=True)
class _Part:
    name: str
    title: str
    tables: tuple[tables.TextTable, ...]
    pictures: list[Picture]


def render_report(inputs: ReportInput, images: Mapping[str, bytes]) -> str:
    """The report as text.

    Parameters
    ----------
    inputs : ReportInput
    images : mapping of str to bytes
        PNG files by name, as of `drawn`.

    Returns
    -------
    str
        A whole HTML document without scripts and without links to other files.

    Raises
    ------
    InputError
        For a figure whose name has no place in the report.
    """
    plan = plan_of_campaign(inputs)
    placed = [*plan, *(name for names in SECTIONS.values() for name in names)]
    for name in images:
        if name not in placed:
            raise InputError(
                f"figure {name!r} has no place in the report",
                do=f"name it one of {', '.join(placed)}",
            )
    return template("report.html.jinja").render(
        run=inputs,
        chips=_chips(inputs),
        verdict=verdict(inputs),
        status=status_checks(inputs),
        pictures={
            section: [picture_of(n, images[n], caption(n, inputs)) for n in names if n in images]
            for section, names in SECTIONS.items()
        },
        campaign=_campaign_parts(inputs, plan, images),
        tables={
            "data": tables.data_tables(inputs),
            "fit": tables.fit_tables(inputs),
            "outliers": _present(tables.outlier_table(inputs)),
            "coefficients": tables.coefficient_tables(inputs),
            "maps": (tables.map_table(inputs),),
            "periods": period_tables(inputs),
            "budget": _present(tables.budget_table(inputs)),
            "margins": _present(tables.margin_table(inputs)),
            "provenance": (
                *tables.provenance_tables(inputs),
                *_present(tables.config_table(inputs)),
            ),
        },
    )


def _chips(inputs: ReportInput) -> str:
    """Names and sizes of the chips, those of equal size together."""
    names: dict[str, list[str]] = {}
    for c in inputs.chips:
        size = "{:g} × {:g}".format(*c.chip.size)
        names.setdefault(size, []).append(c.chip.name or f"chip {c.chip.number}")
    return "; ".join(
        f"{', '.join(several[:-1])}{' and ' if len(several) > 1 else ''}{several[-1]}, {size}"
        for size, several in names.items()
    )


def _present(table: tables.TextTable | None) -> tuple[tables.TextTable, ...]:
    return () if table is None else (table,)


def _campaign_parts(
    inputs: ReportInput, plan: Mapping[str, CampaignFigure], images: Mapping[str, bytes]
) -> list[_Part]:
    """Parts of the section on the campaign; empty ones are left out."""
    if inputs.campaign is None:
        return []
    texts = campaign_tables(inputs.campaign)
    parts = [
        _Part(
            f"campaign-{name}",
            title,
            texts.get(name, ()),
            [
                picture_of(one.name, images[one.name], one.caption)
                for one in plan.values()
                if one.part == name and one.name in images
            ],
        )
        for name, title in PARTS.items()
    ]
    return [part for part in parts if part.tables or part.pictures]


def write_report(
    path: str | os.PathLike[str], inputs: ReportInput, images: Mapping[str, bytes]
) -> None:
    """Write the report.

    Parameters
    ----------
    path : path-like
    inputs : ReportInput
    images : mapping of str to bytes
        PNG files by name, as of `drawn`.

    Raises
    ------
    InputError
        When the file cannot be written, or as `render_report`.
    """
    text = render_report(inputs, images)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
