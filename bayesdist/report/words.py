"""What the same things are called in runs of matched stars and in self-calibrations."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["DETECTED", "MATCHED", "Words"]


@dataclass(frozen=True)
class Words:
    """Words of a report.

    Parameters
    ----------
    things : str
        What is fitted, one row each.
    all_things : str
        These as they come into the fit.
    false : str
        Rows that are none of them.
    chooser : str
        What leaves out rows that are far off: the sampling does not.
    fit : str
        What the parameters are from before they are sampled.
    holder : str
        What holds parameters that the data say nothing of.
    taken : str
        What makes residuals smaller than errors, as a clause; empty where nothing does.
    """

    things: str
    all_things: str
    false: str
    chooser: str
    fit: str
    holder: str
    taken: str = ""


MATCHED = Words(
    things="stars",
    all_things="matched stars",
    false="false matches",
    chooser="least-squares fit",
    fit="linear fit",
    holder="a prior",
)
DETECTED = Words(
    things="detections",
    all_things="detections of stars",
    false="false detections",
    chooser="limits of residuals",
    fit="solution",
    holder="the gauge",
    taken=", less what the fitted stars take of them",
)
