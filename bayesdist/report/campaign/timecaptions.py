"""The words under the figures of linear terms against time, and of two exposures together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesdist.report.campaign.alignment import IN_CELL, largest_vector
from bayesdist.report.campaign.context import CampaignResults
from bayesdist.report.campaign.series import TermCourse
from bayesdist.report.campaign.words import name_of_term
from bayesdist.report.caption import Caption
from bayesdist.report.numbers import count, number, size_of

__all__ = ["caption_of_overlap", "caption_of_series"]

FALLS = 1.2  # scatter before VAFACTOR over that after it, above which the aberration is seen


def caption_of_series(
    r: CampaignResults, term: str, courses: Sequence[TermCourse], *, first: bool
) -> Caption:
    """One linear term of some chips against time; `CampaignResults.series` must be there.

    Parameters
    ----------
    r : CampaignResults
    term : str
        'A_2' for one.
    courses : sequence of TermCourse
        Of the chips in the figure.
    first : bool
        Whether it is the first such figure, whose caption says how to read them.

    Returns
    -------
    Caption
    """
    series, found = r.series, r.section("time_dependence")
    assert series is not None
    unit = r.unit if courses[0].is_constant else ""

    def size(value: float | None) -> str:
        if value is None or not np.isfinite(value):
            return "unknown"
        return size_of(value, unit) if unit else number(value, 2)

    def each(texts: Sequence[str]) -> str:
        one = zip(courses, texts, strict=True)
        return "; ".join(f"{c.chip} {text}" if c.chip else text for c, text in one)

    rms = each([f"from {size(c.rms_raw)} to {size(c.rms)}" for c in courses])
    own = each([size(found.get("scatter", {}).get(c.label)) for c in courses])
    verdicts = {row["term"]: row["claim"] for row in found.get("verdicts", ())}
    falls = all(c.rms_raw > FALLS * c.rms for c in courses)
    with_roll = bool(np.isfinite(series.pa_v3).any())
    text = _how_to_read(r, with_roll) if first else "As the figure before."
    text += (
        f" With VAFACTOR the scatter about the lines {'falls' if falls else 'hardly changes'}:"
        f" {rms}. Beyond the formal errors the exposures scatter by {own}."
    )
    if all(c.label in verdicts for c in courses):
        text += f" What held-out exposures support: {each([verdicts[c.label] for c in courses])}."
    off = int(series.outlying.sum())
    text += f" Crosses mark {count(off)} outlying exposures." if off else " No exposure lies off."
    if not found.get("converged", True):
        text += " The sampler of the lines did not reach its targets: bands are provisional."
    return Caption(
        f"{name_of_term(term)} against time",
        text,
        f"{name_of_term(term)} against time and roll angle; scatter about the lines {rms}.",
    )


def _how_to_read(r: CampaignResults, with_roll: bool) -> str:
    places = ", left against time and right against PA_V3" if with_roll else ""
    g = r.section("gauge")
    gauge = ""
    if g:
        fixed = ", ".join(g["fixed"])
        gauge = f", shifted and turned so that {fixed} of {r.chip_name(g['chip'])} are zero in it"
    return (
        f"Each exposure fitted by itself{gauge}, with formal errors{places}. Top: as measured."
        " Middle:"
        " VAFACTOR applied, with the line of each segment, its 68 % band and the wider one of a"
        " new exposure. Bottom: rate times time since the reference date taken out; steps between"
        " segments stay."
    )


def caption_of_overlap(r: CampaignResults) -> Caption:
    """Two exposures laid on each other; `CampaignResults.overlap` must be there."""
    t = r.overlap
    assert t is not None
    a, b = t.names
    days = abs(t.epochs[1] - t.epochs[0])
    rolls = ""
    if np.isfinite(t.pa_v3).all():
        rolls = f" and PA_V3 {t.pa_v3[0]:.0f}° and {t.pa_v3[1]:.0f}°"
    old, new = (float(np.sqrt(np.mean(x.rms**2))) for x in (t.old, t.new))
    text = (
        f"{a} and {b} ({t.epochs[0]:.2f} and {t.epochs[1]:.2f}, {days:.1f} years apart{rolls}):"
        f" {count(t.n_stars)} shared stars, corrected for distortion and brought onto each other by"
        " shift, rotation and scale; mean of what is left in each cell of"
        f" {IN_CELL} stars or more. Left: through the known distortion that the matching started"
        " from; right: through tables, polynomial and drift of this run, without anything fitted"
        f" to these two exposures. Largest cell {size_of(largest_vector(t.binned_old))} and"
        f" {size_of(largest_vector(t.binned_new))}; rms of an axis over the stars"
        f" {size_of(old)} and {size_of(new)}."
    )
    if t.with_motions:
        text += " The catalogue's proper motions between the two dates are taken out."
    text += f" Pixels of {t.pixel_mas:g} mas; both panels have one scale."
    return Caption(
        "Two exposures laid on each other",
        text,
        "Residual vectors between two exposures, with a pattern on the left and little on the"
        f" right: rms {size_of(old)} and {size_of(new)}.",
    )
