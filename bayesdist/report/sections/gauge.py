"""The gauge of coefficients and errors, in sentences.

A change that is common to all frames is equivalent to a change of the polynomials. Shift and
rotation of a solution are therefore meaningless until their zero points are defined.
"""

from __future__ import annotations

from bayesdist.report.run import ReportedRun


def gauge_mark(run: ReportedRun) -> str:
    """Clause of a caption about the gauge; empty if a single system leaves no choice."""
    return ", in the fit's own gauge" if run.model.n_frame else ""


def gauge_note(run: ReportedRun) -> str:
    """Sentences on the gauge of the fit; empty if there is no choice."""
    model = run.model
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


def gauge_of_maps(run: ReportedRun) -> str:
    """Sentence on shift and rotation in the maps of the uncertainty; empty without frames."""
    if not run.model.n_frame:
        return ""
    return run.kind.words.gauge_of_maps.format(first=run.model.exposures[0])
