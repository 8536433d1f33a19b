"""What the report shows of a campaign: matching, look-up tables, linear terms against time."""

from bayesdist.report.campaign.context import (
    CampaignResults,
    CatalogStars,
    ChipResiduals,
    Detections,
    Footprints,
    LinearSeries,
    OverlapTest,
)
from bayesdist.report.campaign.figures import (
    PARTS,
    CampaignFigure,
    campaign_draws,
    campaign_figures,
)
from bayesdist.report.campaign.status import campaign_checks
from bayesdist.report.campaign.texttables import campaign_tables

__all__ = [
    "PARTS",
    "CampaignFigure",
    "CampaignResults",
    "CatalogStars",
    "ChipResiduals",
    "Detections",
    "Footprints",
    "LinearSeries",
    "OverlapTest",
    "campaign_checks",
    "campaign_draws",
    "campaign_figures",
    "campaign_tables",
]
