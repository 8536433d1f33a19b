"""The gauge of coefficients and errors, in sentences.

A change that is common to all frames is equivalent to a change of the polynomials. Shift and
rotation of a solution are therefore meaningless until their zero points are defined.
"""

from __future__ import annotations

from bayesdist.report.context import ReportInput


def gauge_mark(r: ReportInput) -> str:
    """Clause of a caption about the gauge; empty if a single system leaves no choice."""
    return ", in the fit's own gauge" if r.fit.model.n_frame else ""


def gauge_note(r: ReportInput) -> str:
    """Sentences on the gauge of the fit; empty if there is no choice."""
    model = r.fit.model
    if not model.n_frame:
        return ""
    first = model.exposures[0]
    if model.gauge == "first":
        return f"The fit's own gauge: the polynomials are those of exposure {first}, as it lies."
    chip = model.chips[0].name
    return (
        f"The fit's own gauge: exposure {first} is held where its own stars on {chip} put it, so"
        f" that shift and rotation of {chip} are near zero, and not exactly zero. The linear terms"
        f" against time are in another gauge, in which they are."
    )


def gauge_of_maps(r: ReportInput) -> str:
    """Sentence on shift and rotation in the maps of the uncertainty; empty without frames."""
    if not r.fit.model.n_frame:
        return ""
    return r.words.gauge_of_maps.format(first=r.fit.model.exposures[0])
