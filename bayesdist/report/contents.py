"""Sections of the pages in their order, and the documentation that explains each."""

from __future__ import annotations

from bayesdist.report.registry import Registry, Section

REPORT = Registry(
    "report",
    (
        Section("status", "Status"),
        Section("holdout", "Held-out stars"),
        # a campaign's matching describes its data
        Section("data", "Data", printed=lambda r: r.campaign is None),
        Section("campaign", "Campaign"),
        Section("campaign-matching", "Catalogue and matching", parent="campaign"),
        Section("campaign-tables", "Look-up tables", parent="campaign"),
        Section("campaign-time", "Linear terms against time", parent="campaign"),
        Section(
            "campaign-release",
            "Released files and the alignment of two exposures",
            parent="campaign",
            printed=False,  # the products have their files
        ),
        Section("selfcal", "Gauge and stars"),
        Section(
            "fit",
            lambda r: "Least-squares fit" if r.selfcal is None else r.words.fit.capitalize(),
        ),
        Section("residuals", "Residuals"),
        Section(
            "outliers",
            "Outliers",
            printed=False,
            empty="Nothing was sampled: the fit rejects outliers by its limits and does not model"
            " them.",
        ),
        Section("coefficients", "Coefficients", printed=False),
        Section("maps", "Distortion and its uncertainty over the detector"),
        Section("periods", "Time variation"),
        Section("budget", "Error budget", empty="No error budget was made."),
        Section("margins", "Margins", empty="No requirement was stated."),
        Section("products", "Products", empty="No product was written."),
        Section("provenance", "Provenance"),
    ),
)


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
    "Gauge": "selfcal",
    "Sampling": "outliers",
    "Score tests": "fit",
    "Fit": "fit",
    "Matching": "data",
    "Errors": "budget",
    "Assumptions": "budget",
    "Periods": "periods",
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
