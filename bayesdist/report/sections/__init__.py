"""Sections of the report of a run; importing this registers all of them."""

from bayesdist.report.contents import REPORT
from bayesdist.report.sections import explorer
from bayesdist.report.sections.campaign import lines, lookup, matching, release, selfcal, series
from bayesdist.report.sections.run import (
    budget,
    coefficients,
    data,
    fit,
    holdout,
    maps,
    margins,
    periods,
    posterior,
    provenance,
    residuals,
    status,
)

__all__ = [
    "REPORT",
    "budget",
    "coefficients",
    "data",
    "explorer",
    "fit",
    "holdout",
    "lines",
    "lookup",
    "maps",
    "margins",
    "matching",
    "periods",
    "posterior",
    "provenance",
    "release",
    "residuals",
    "selfcal",
    "series",
    "status",
]
