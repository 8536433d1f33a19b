"""The report: one HTML file that needs nothing else, and the same as Markdown."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bayesdist.data.files import atomic_path
from bayesdist.errors import InputError
from bayesdist.report import tables
from bayesdist.report.campaign import PARTS, CampaignFigure, campaign_tables
from bayesdist.report.captions import SECTIONS, caption
from bayesdist.report.context import ReportInput
from bayesdist.report.explorer import budget_data, embedded, map_data
from bayesdist.report.figures import plan_of_campaign
from bayesdist.report.holdout import holdout_tables
from bayesdist.report.page import Picture, picture_of, template
from bayesdist.report.periods import period_tables
from bayesdist.report.selfcal import selfcal_tables
from bayesdist.report.status import status_checks, verdict

__all__ = ["render_markdown", "render_report", "write_report"]

_TITLES = {
    "holdout": "Held-out stars",
    "data": "Data",
    "campaign": "Campaign",
    "selfcal": "Gauge and stars",
    "fit": "Least-squares fit",
    "outliers": "Outliers",
    "coefficients": "Coefficients",
    "maps": "Distortion and its uncertainty over the detector",
    "periods": "Time variation",
    "budget": "Error budget",
    "margins": "Margins",
    "products": "Products",
    "provenance": "Provenance",
}
_EMPTY = {
    "outliers": "Nothing was sampled: the fit rejects outliers by its limits and does not model"
    " them.",
    "budget": "No error budget was made.",
    "margins": "No requirement was stated.",
    "products": "No product was written.",
}
_PROVISIONAL = (
    "The sampler did not reach its targets. Every number below is provisional; those marked † rest"
    " on its draws and may be wrong by more than their stated errors. Sample longer, or look at the"
    " reasons, before anything is used."
)
_FOOTER = (
    "u and v are the reference axes; x runs to the right and y up, in FITS"
    " pixels (centre of the first pixel = 1)."
)
_BUDGET_WORDS = (
    "The budget of the table, computed in this page at any position, between two positions of one"
    " image, and at any epoch and magnitude. The parts of the model are correlated: the bar stacks"
    " variances, and the hatched piece is what their correlation adds. Where it takes off, the"
    " stack is longer than the total, which the dark line marks; in the table it then has a minus"
    " before the root of its size."
)
_PRINT_WORDS = (
    "In print: what decides. All tables and figures, and the budget at any position and epoch, are"
    " in report.html; the figures also lie in figures/."
)
# figures that a printed report shows: what a board signs, not what an analyst looks through
_PRINTED = (
    "residual_histogram",
    "residual_vectors",
    "distortion",
    "uncertainty_radius",
    "pixel_area",
    "period_differences",
    "holdout",
    "margins",
    "horizon",
)
_CAMPAIGN_PRINTED = ("distortion", "uncertainty_radius", "margins", "horizon")


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
        A whole HTML document that needs no other file.  Its script computes from numbers in the
        page; whoever does without sees all tables and figures.

    Raises
    ------
    InputError
        For a figure whose name has no place in the report.
    """
    return template("report.html.jinja").render(
        **_contents(inputs, images),
        trace=f"{inputs.name} · {_maker(inputs)}",
        budget_words=_BUDGET_WORDS,
        print_words=_PRINT_WORDS,
        printed=_printed(inputs),
        # a campaign's matching says what its data are
        unprinted=() if inputs.campaign is None else ("data",),
        map_data=embedded(map_data(inputs)),
        budget_data=None if inputs.surface is None else embedded(budget_data(inputs)),
    )


def _maker(inputs: ReportInput) -> str:
    """Version and time by which a copy on paper is traced to its run, as far as they are known."""
    versions = inputs.provenance.get("versions", {})
    began = str(inputs.provenance.get("created", "")).replace("T", " ").replace("+00:00", " UTC")
    return " ".join(
        part
        for part in (
            "bayesdist",
            str(versions.get("bayesdist", "")),
            f"in a run of {began}" if began else "",
        )
        if part
    )


def _printed(inputs: ReportInput) -> tuple[str, ...]:
    """Figures on paper; of a campaign the first drift in place of the residuals."""
    drifts = [one.name for one in plan_of_campaign(inputs).values() if one.part == "time"]
    return _PRINTED if inputs.campaign is None else (*drifts[:1], *_CAMPAIGN_PRINTED)


def render_markdown(inputs: ReportInput, images: Mapping[str, bytes]) -> str:
    """The same tables, figures and words as Markdown; figures are links into figures/.

    Parameters
    ----------
    inputs, images
        As in `render_report`.
    """
    return template("report.md.jinja").render(**_contents(inputs, images))


def _contents(inputs: ReportInput, images: Mapping[str, bytes]) -> dict[str, Any]:
    """What every form of the report shows."""
    plan = plan_of_campaign(inputs)
    placed = [*plan, *(name for names in SECTIONS.values() for name in names)]
    for name in images:
        if name not in placed:
            raise InputError(
                f"figure {name!r} has no place in the report",
                do=f"name it one of {', '.join(placed)}",
            )
    campaign = _campaign_parts(inputs, plan, images)
    titles = {k: v for k, v in _TITLES.items() if k != "campaign" or campaign}
    if inputs.periods is None:
        del titles["periods"]
    if inputs.held_out is None:
        del titles["holdout"]
    if inputs.selfcal is None:
        del titles["selfcal"]
    else:
        titles["fit"] = inputs.words.fit.capitalize()
    return {
        "run": inputs,
        "sections": titles,
        "empty": _EMPTY,
        "provisional": _PROVISIONAL,
        "footer": f"Made by {_maker(inputs)}. {_FOOTER}",
        "chips": _chips(inputs),
        "verdict": verdict(inputs),
        "status": status_checks(inputs),
        "pictures": {
            section: [picture_of(n, images[n], caption(n, inputs)) for n in names if n in images]
            for section, names in SECTIONS.items()
        },
        "campaign": campaign,
        "tables": {
            "holdout": holdout_tables(inputs.held_out),
            "data": tables.data_tables(inputs),
            "selfcal": selfcal_tables(inputs),
            "fit": (*tables.fit_tables(inputs), *_present(tables.score_test_table(inputs))),
            "outliers": _present(tables.outlier_table(inputs), tables.added_errors_table(inputs)),
            "coefficients": tables.coefficient_tables(inputs),
            "maps": (tables.map_table(inputs),),
            "periods": period_tables(inputs),
            "budget": _present(tables.budget_table(inputs)),
            "margins": (
                *_present(tables.margin_table(inputs)),
                *_present(tables.rests_on_table(inputs)),
            ),
            "provenance": (
                *tables.provenance_tables(inputs),
                *_present(tables.config_table(inputs)),
            ),
        },
    }


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


def _present(*found: tables.TextTable | None) -> tuple[tables.TextTable, ...]:
    return tuple(table for table in found if table is not None)


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
    """Write the report, and beside it the same as Markdown.

    Parameters
    ----------
    path : path-like
        Of the page; the other file has its name with .md for .html.
    inputs : ReportInput
    images : mapping of str to bytes
        PNG files by name, as of `drawn`.

    Raises
    ------
    InputError
        When the file cannot be written, or as `render_report`.
    """
    texts = {
        Path(path): render_report(inputs, images),
        Path(path).with_suffix(".md"): render_markdown(inputs, images),
    }
    for target, text in texts.items():
        with atomic_path(target) as temporary:
            temporary.write_text(text, encoding="utf-8")
