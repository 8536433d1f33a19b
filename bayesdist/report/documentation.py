"""Pages of the documentation that explain what a report shows."""

from __future__ import annotations

__all__ = ["BASE", "page_of"]

BASE = "https://bayesdist.readthedocs.io/en/latest/"  # where docs/ is published

_FIGURES = "report.html#figures"
# by section of the report, or group of the status table
_PAGES = {
    "status": "report.html#on-top",
    "data": "your_table.html",
    "campaign": "campaign.html",
    "campaign-matching": "campaign.html#the-catalogue",
    "campaign-tables": "campaign.html",
    "campaign-time": "campaign.html",
    "campaign-release": "campaign.html",
    "selfcal": "self_calibration.html",
    "fit": "method.html#linear-fit",
    "residuals": "method.html#tests-for-what-a-model-lacks",
    "outliers": "concepts.html#jitter-and-membership",
    "coefficients": "method.html#model",
    "maps": "concepts.html#what-68-means",
    "periods": "wise.html",
    "budget": "method.html#error-budget-and-margins",
    "margins": "method.html#what-a-verdict-rests-on",
    "holdout": "method.html#held-out-stars",
    "products": "files.html",
    "provenance": "files.html",
    "Held-out truth": "method.html#held-out-stars",
    "Campaign": "campaign.html",
    "Sampling": "concepts.html#convergence-is-another-matter",
    "Fit": "method.html#linear-fit",
    "Assumptions": "method.html#the-catalogues-error",
    "Requirements": "method.html#what-a-verdict-rests-on",
    "Validity": "method.html#limits",
    "Products": "files.html",
}


def page_of(name: str) -> str:
    """Address of the page about a section or a group of the status table."""
    return BASE + _PAGES.get(name, _FIGURES)
