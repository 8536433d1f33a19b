"""Sections of the report of a run, in their order."""

from __future__ import annotations

from bayesdist.report.context import ReportInput
from bayesdist.report.registry import Registry, Section

__all__ = ["REPORT"]


def _fit_title(r: ReportInput) -> str:
    return "Least-squares fit" if r.selfcal is None else r.words.fit.capitalize()


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
        Section("fit", _fit_title),
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
