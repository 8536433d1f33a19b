"""Pages of the documentation that explain what a report shows: `bayesdist docs PAGE` has them."""

from __future__ import annotations

__all__ = ["EXPLAINED", "explanation_of", "section_of"]

# page and heading by section of the report
EXPLAINED = {
    "status": ("report", "On top"),
    "data": ("your_table", ""),
    "campaign": ("campaign", ""),
    "campaign-matching": ("campaign", "The catalogue"),
    "campaign-tables": ("campaign", ""),
    "campaign-time": ("campaign", ""),
    "campaign-release": ("campaign", ""),
    "selfcal": ("self_calibration", ""),
    "fit": ("method", "Linear fit"),
    "residuals": ("method", "Tests for what a model lacks"),
    "outliers": ("concepts", "Jitter and membership"),
    "coefficients": ("method", "Model"),
    "maps": ("concepts", "What 68 % means"),
    "periods": ("wise", ""),
    "budget": ("method", "Error budget and margins"),
    "margins": ("method", "What a verdict rests on"),
    "holdout": ("method", "Held-out stars"),
    "products": ("files", ""),
    "provenance": ("files", ""),
}
_ANY = ("report", "Figures")  # of pages that are not the report of a run

# section of the report that has the numbers behind a group of the status table
_SECTIONS = {
    "Held-out truth": "holdout",
    "Campaign": "campaign",
    "Sampling": "outliers",
    "Fit": "fit",
    "Assumptions": "budget",
    "Requirements": "margins",
    "Validity": "margins",
    "Products": "products",
}


def explanation_of(section: str) -> str:
    """Command that shows the page about a section, and the heading to look for."""
    page, heading = EXPLAINED.get(section, _ANY)
    return f"bayesdist docs {page}" + (f", “{heading}”" if heading else "")


def section_of(group: str) -> str:
    """Section of the report behind a group of the status table; the group itself if none is."""
    return _SECTIONS.get(group, group)
