"""What the configuration says of a campaign."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat

from bayesdist.app.config.section import Section

__all__ = ["CampaignBlock", "ReleaseBlock", "StarListsBlock", "TablesBlock"]

Between = tuple[float, float]


class StarListsBlock(Section):
    """Star lists, and which of their detections are used."""

    lists: str | list[str]
    columns: dict[str, str] | None = None
    mag: Between | None = None
    saturation: float | None = None
    q_max: PositiveFloat | None = None
    simulated: bool = False


class CampaignBlock(StarListsBlock):
    """Star lists, the catalogue that they are matched with, and what is known of the exposures."""

    catalog: str
    exposures: str
    initial_distortion: str
    catalog_columns: dict[str, str] | None = None
    unit: Literal["pix", "arcsec", "mas", "deg"] | None = None
    catalogue_epoch: float | None = None
    parity: Literal["auto", "direct", "mirrored"] = "auto"
    filter: str | None = None
    radius: PositiveFloat | None = None
    pm_selection: Literal["reliable", "all"] = "reliable"
    vafactor_source: Literal["log", "earth"] = "log"


class TablesBlock(Section):
    """Look-up tables that are fitted: the detector's, or the filter's over those of a detector."""

    detector: str | None = None
    method: Literal["field", "binned", "none"] = "field"
    step: tuple[PositiveFloat, PositiveFloat] = (64.0, 64.0)
    max_iterations: Annotated[int, Field(ge=1)] = 8


class PeriodBlock(Section):
    """The years that one IDCTAB serves, and the segment of the drift that it holds."""

    name: str
    years: Between
    segment: Annotated[int, Field(ge=0)] = 0
    useafter: str | None = None
    pedigree: str | None = None


class ReleaseBlock(Section):
    """IDCTABs, D2IMFILE and NPOLFILE, along V2 and V3 as an existing IDCTAB lies."""

    name: str
    reference: str
    period: Annotated[list[PeriodBlock], Field(min_length=1)]
    instrument: str = "ACS"
    detector: str = "WFC"
    scale_arcsec: PositiveFloat = 0.05
    limit_mas: PositiveFloat = 0.1
