"""Status rows of a campaign."""

from __future__ import annotations

from bayesdist.report.campaign import CampaignResults
from bayesdist.report.context import Check
from bayesdist.report.numbers import count, percent
from bayesdist.report.sections.checks import structure_check

__all__ = [
    "campaign_checks",
]

_COMPLETE = 0.8  # below it stars are missed for a reason, and are a selection
_FALSE = 0.01  # the outlier model can take more, but so many mean that matching went wrong


def _level(good: bool) -> str:
    return "pass" if good else "warn"


def campaign_checks(r: CampaignResults) -> tuple[Check, ...]:
    """Criteria of matching, tables, series, residuals and warnings."""
    m, tables, time = (r.section(k) for k in ("matching", "tables", "time_dependence"))
    least = float(m["completeness"]["least"])
    false = float(m["false_share"])
    out = [
        Check(
            "Matching: completeness of the exposures",
            f"{percent(m['completeness']['median'])} at the median, {percent(least)} at least",
            f"at least {percent(_COMPLETE, 2)} in each",
            _level(least >= _COMPLETE),
        ),
        Check(
            "Matching: false pairs expected",
            percent(false, 2),
            f"at most {percent(_FALSE, 2)}",
            _level(false <= _FALSE),
        ),
    ]
    if m.get("left_out"):
        names = "; ".join(m["left_out"])
        out.append(Check("Matching: exposures left out", names, "none", "warn"))
    if "converged" in tables:
        good = bool(tables["converged"])
        out.append(Check("Look-up tables converged", "yes" if good else "NO", "yes", _level(good)))
    if "converged" in time:
        good = bool(time["converged"])
        text = "yes" if good else "NO"
        out.append(Check("Series of linear terms converged", text, "yes", _level(good)))
        off = len(time.get("outlying_exposures", ()))
        out.append(Check("Exposures that lie off the lines", count(off)))
    wrong = r.summary.get("exposures_outlying") or ()
    if wrong:
        names = ", ".join(str(name) for name in wrong)
        out.append(Check("Exposures that went wrong in the joint fit", names, "none", "warn"))
    skipped = r.summary.get("exposures_skipped") or {}
    if skipped:
        out.append(
            Check("Exposures that could not be fitted alone", ", ".join(skipped), "none", "warn")
        )
    if r.misfits:
        out.append(structure_check(r.misfits, fit="the joint fit"))
    out.append(
        Check(
            "Other doubts" if r.misfits else "Doubts",
            "none" if not r.doubts else "; ".join(d[0].upper() + d[1:] for d in r.doubts),
            "none",
            _level(not r.doubts),
        )
    )
    return tuple(out)
