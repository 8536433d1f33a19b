"""All figures of a campaign, by name, in the parts of its section."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

from matplotlib.figure import Figure

from bayesdist.report.campaign.alignment import overlap_residuals
from bayesdist.report.campaign.captions import (
    caption_of_catalogue,
    caption_of_footprints,
    caption_of_map,
    caption_of_matching,
    caption_of_node_errors,
    caption_of_nodes,
    caption_of_quality,
    caption_of_residuals,
)
from bayesdist.report.campaign.catalogue import catalogue_errors, fit_quality
from bayesdist.report.campaign.context import CampaignResults, ChipResiduals
from bayesdist.report.campaign.matching import footprints, matching_by_exposure
from bayesdist.report.campaign.residuals import residual_map, table_residuals
from bayesdist.report.campaign.series import ABREAST, course_of, series_figure, terms_of
from bayesdist.report.campaign.tables import node_errors, node_vectors
from bayesdist.report.campaign.timecaptions import caption_of_overlap, caption_of_series
from bayesdist.report.caption import Caption
from bayesdist.report.mosaic import Mosaic

__all__ = ["PARTS", "CampaignFigure", "campaign_draws", "campaign_figures"]

# parts of the section, in their order: name and heading
PARTS = {
    "matching": "Catalogue and matching",
    "tables": "Look-up tables",
    "time": "Linear terms against time",
    "release": "Released files and two exposures laid on each other",
}


@dataclass(frozen=True, eq=False)
class CampaignFigure:
    """A figure that can be drawn, with its words and its place.

    Parameters
    ----------
    name : str
        Serves as file name.
    part : str
        One of `PARTS`.
    draw : callable
        Makes the figure.
    caption : Caption
    """

    name: str
    part: str
    draw: Callable[[], Figure]
    caption: Caption


def campaign_figures(results: CampaignResults, mosaic: Mosaic) -> dict[str, CampaignFigure]:
    """Every figure that a campaign allows, in the order of the report.

    Parameters
    ----------
    results : CampaignResults
    mosaic : Mosaic
        How the chips are drawn, in the order of the model.

    Returns
    -------
    dict of str to CampaignFigure
    """
    made = (
        *_matching(results),
        *_tables(results, mosaic),
        *_time(results),
        *_release(results),
    )
    return {one.name: one for one in made}


def campaign_draws(results: CampaignResults, mosaic: Mosaic) -> dict[str, Callable[[], Figure]]:
    """What draws each of them."""
    return {name: one.draw for name, one in campaign_figures(results, mosaic).items()}


def _matching(r: CampaignResults) -> Iterator[CampaignFigure]:
    part = "matching"
    if r.catalog is not None:
        draw = partial(catalogue_errors, r.catalog, r.centroids)
        yield CampaignFigure("catalogue_errors", part, draw, caption_of_catalogue(r))
    if r.detections is not None:
        draw = partial(fit_quality, r.detections)
        yield CampaignFigure("fit_quality", part, draw, caption_of_quality(r))
    draw = partial(matching_by_exposure, r.matching)
    yield CampaignFigure("matching", part, draw, caption_of_matching(r))
    if r.footprints is not None:
        draw = partial(footprints, r.footprints)
        yield CampaignFigure("footprints", part, draw, caption_of_footprints(r))


def _tables(r: CampaignResults, mosaic: Mosaic) -> Iterator[CampaignFigure]:
    part = "tables"
    if r.residuals:
        if r.tables:
            draw = partial(table_residuals, _from_top(r, mosaic))
            yield CampaignFigure("table_residuals", part, draw, caption_of_residuals(r))
        for which in ("without", "with") if r.tables else ("without",):
            draw = partial(residual_map, r.residuals, which, mosaic=mosaic)
            words = caption_of_map(r, which)
            yield CampaignFigure(f"residuals_{which}_tables", part, draw, words)
    for filter in r.table_filters:
        some = [t for t in r.tables if t.filter == filter]
        suffix = f"_{filter}" if filter else ""
        draw = partial(node_vectors, some, r.chips, mosaic=mosaic)
        words = caption_of_nodes(r, some, filter)
        yield CampaignFigure(f"table_nodes{suffix}", part, draw, words)
        if any(t.sigma is not None for t in some):
            draw = partial(node_errors, some, r.chips, mosaic=mosaic)
            words = caption_of_node_errors(r, some, filter)
            yield CampaignFigure(f"table_errors{suffix}", part, draw, words)


def _from_top(r: CampaignResults, mosaic: Mosaic) -> list[ChipResiduals]:
    order = sorted(range(len(r.residuals)), key=lambda k: mosaic.places[k])
    return [r.residuals[k] for k in order]


def _time(r: CampaignResults) -> Iterator[CampaignFigure]:
    if r.series is None:
        return
    lines = r.section("time_dependence").get("lines", [])
    first = True
    for term, labels in terms_of(r.series).items():
        courses = [course_of(r.series, lines, label) for label in labels]
        for n, start in enumerate(range(0, len(courses), ABREAST)):
            some = courses[start : start + ABREAST]
            name = f"series_{term}" + (f"_{n + 1}" if n else "")
            draw = partial(series_figure, r.series, some, unit=r.unit)
            words = caption_of_series(r, term, some, first=first)
            yield CampaignFigure(name, "time", draw, words)
            first = False


def _release(r: CampaignResults) -> Iterator[CampaignFigure]:
    if r.overlap is not None:
        draw = partial(overlap_residuals, r.overlap)
        yield CampaignFigure("overlap", "release", draw, caption_of_overlap(r))
