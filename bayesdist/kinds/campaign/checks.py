"""Checks of a campaign: matching, look-up tables, and series of exposures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayesdist.utils.checks import LARGER, Check, level_of
from bayesdist.utils.limits import COMPLETENESS, FALSE_MATCHES
from bayesdist.utils.numbers import count, percent

GROUP = "Campaign"

# sections with warnings for the reader, their titles, and their effect on verdicts; deviations that
# drift with time are not included in the errors drawn for a later exposure
WARNING = {
    "matching": ("Matching", ""),
    "deviations": ("Deviations of the exposures", LARGER),
    "tables": ("Look-up tables", ""),
    "time_dependence": ("Time dependence", ""),
}


def campaign_checks(summary: Mapping[str, Any]) -> tuple[Check, ...]:
    """Checks of matching, tables and series, including warnings of their stages."""
    m, tables, time = (summary.get(k) or {} for k in ("matching", "tables", "time_dependence"))
    lowest = float(m["completeness"]["least"])
    false = float(m["false_fraction"])
    out = [
        Check(
            GROUP,
            "Matching: completeness of the exposures",
            f"{percent(m['completeness']['median'])} at the median, {percent(lowest)} at least",
            f"at least {percent(COMPLETENESS.value, 2)} in each",
            level_of(COMPLETENESS.met_by(lowest), "warn"),
        ),
        Check(
            GROUP,
            "Matching: false pairs expected",
            percent(false, 2),
            f"at most {percent(FALSE_MATCHES.value, 2)}",
            level_of(FALSE_MATCHES.met_by(false), "warn"),
        ),
    ]
    if m.get("left_out"):
        names = "; ".join(m["left_out"])
        out.append(Check(GROUP, "Matching: exposures left out", names, "none", "warn"))
    if "converged" in tables:
        out.append(_converged("Look-up tables converged", tables))
    if "converged" in time:
        out.append(_converged("Series of linear terms converged", time))
        off = len(time.get("outlying_exposures", ()))
        out.append(Check(GROUP, "Exposures that lie off the lines", count(off)))
    for title, key in (
        ("Exposures that went wrong in the joint fit", "exposures_outlying"),
        ("Exposures that could not be fitted alone", "exposures_skipped"),
    ):
        names = ", ".join(str(name) for name in summary.get(key) or ())
        if names:
            out.append(Check(GROUP, title, names, "none", "warn"))
    out += [
        Check(GROUP, name, level="warn", sentence=text, doubt=doubt)
        for part, (name, doubt) in WARNING.items()
        for text in summary.get(part, {}).get("warnings", [])
    ]
    return tuple(out)


def _converged(what: str, section: Mapping[str, Any]) -> Check:
    good = bool(section["converged"])
    return Check(GROUP, what, "yes" if good else "NO", "yes", level_of(good, "warn"))
