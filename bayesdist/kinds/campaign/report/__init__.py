"""Figures and tables of campaigns; importing this package adds them to the report."""

from typing import Any

from bayesdist.kinds.campaign.report import linear_terms, lookup, matching, release  # noqa: F401
from bayesdist.kinds.campaign.report.data import CampaignData
from bayesdist.report.contents import REPORT, PageSection

__all__: list[str] = []


def _is_campaign(run: Any) -> bool:
    """True for the run of a campaign."""
    return isinstance(run.report_data, CampaignData)


REPORT.insert(
    "data",
    PageSection(
        "campaign",
        "Campaign",
        when=_is_campaign,
        explained=("campaign", ""),
        groups=("Campaign",),
    ),
    PageSection(
        "campaign-matching",
        "Catalogue and matching",
        parent="campaign",
        when=_is_campaign,
        explained=("campaign", "The catalogue"),
    ),
    PageSection(
        "campaign-tables",
        "Look-up tables",
        parent="campaign",
        when=_is_campaign,
        explained=("campaign", ""),
    ),
    PageSection(
        "campaign-time",
        "Linear terms against time",
        parent="campaign",
        when=_is_campaign,
        explained=("campaign", ""),
    ),
    PageSection(
        "campaign-release",
        "Released files and the alignment of two exposures",
        parent="campaign",
        printed=False,  # these products are in files
        when=_is_campaign,
        explained=("campaign", ""),
    ),
)
