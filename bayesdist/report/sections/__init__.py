"""Sections of the report of a run; importing this registers all of them.

Modules that missions name add theirs, after the rest.
"""

from importlib import import_module

from bayesdist.mission import missions
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

for _mission in missions().values():
    if _mission.report:
        import_module(_mission.report)
