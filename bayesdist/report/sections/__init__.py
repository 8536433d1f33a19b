"""Sections of the report of a run; importing this package registers all of them.

Modules named by plugins add those of kinds of runs and of missions.
"""

from bayesdist.plugin import import_reports
from bayesdist.report.contents import REPORT
from bayesdist.report.sections import (  # noqa: F401
    budget,
    explorer,
    fit,
    maps,
    periods,
    posterior,
    provenance,
    residuals,
    status,
)

__all__ = ["REPORT"]

import_reports()
