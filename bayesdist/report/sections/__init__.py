"""Sections of the report of a run; importing this package registers all of them.

Modules named by missions add their sections at the end.
"""

from bayesdist.plugin import import_reports
from bayesdist.report.contents import REPORT
from bayesdist.report.sections import explorer  # noqa: F401
from bayesdist.report.sections.campaign import (  # noqa: F401
    lines,
    lookup,
    matching,
    release,
    selfcal,
    series,
)
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
