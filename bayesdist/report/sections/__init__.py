"""Sections of the report of a run; importing this package registers all of them.

Modules named by plugins add those of kinds of runs and of missions.
"""

from bayesdist.plugin import import_reports
from bayesdist.report.contents import REPORT
from bayesdist.report.sections import explorer  # noqa: F401
from bayesdist.report.sections.run import (  # noqa: F401
    budget,
    coefficients,
    data,
    fit,
    holdout,
    maps,
    margins,
    periods,
    posterior,
    previous,
    provenance,
    residuals,
    status,
    trends,
)

__all__ = ["REPORT"]

import_reports()
