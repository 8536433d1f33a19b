"""Difference from the release that a calibration replaces."""

from __future__ import annotations

import numpy as np

from bayesdist.report.contents import REPORT, Plot
from bayesdist.report.figures.commands import difference_vectors
from bayesdist.report.run import ReportedRun, scale_mas
from bayesdist.report.texttable import TextTable, tabulated
from bayesdist.utils.text import MISSING, number, percent, with_mas

ERRORS = {
    "both": "The errors of both are taken as independent.",
    "A": "The release states no errors and is taken for exact.",
    "B": "This run states no errors and is taken for exact.",
    "none": "Neither states errors.",
}


@REPORT.table("previous", needs=("previous",))
def previous_table(run: ReportedRun) -> TextTable:
    """Table of the difference of each chip, its significance, and what was removed."""
    rows = []
    for comparison in run.previous:
        mas = comparison.frame.pixel_mas or scale_mas(run)
        field, similarity = comparison.field, comparison.similarity
        verdict = {True: "differs", False: "within the errors", None: "not tested"}[
            comparison.differs
        ]
        chip = next(
            (c for c in run.model.chips if c.number == comparison.a.chip),
            run.model.chips[0],
        )
        shift = None if similarity.shift is None else float(np.hypot(*similarity.shift))
        scale = percent(similarity.scale - 1.0, 2) if similarity.same_unit else MISSING
        rows.append(
            {
                "Chip": chip.name or str(chip.number),
                "rms": with_mas(comparison.rms, "pix", mas),
                "Largest": with_mas(comparison.largest, "pix", mas),
                "At pixel": "({:.0f}, {:.0f})".format(*comparison.position_of_largest),
                "Chi-square (dof)": MISSING
                if field is None
                else f"{number(field.chi2)} ({field.dof})",
                "p": MISSING if field is None else number(field.p_value, 2),
                "Shift [pix]": number(shift),
                "Scale − 1": scale,
                "Rotation [°]": number(float(np.degrees(similarity.rotation)), 3),
                "Result": verdict,
            }
        )
    first = run.previous[0]
    return tabulated(
        f"This run minus {first.b.name}",
        rows,
        words=(0, 9),
        stacked=(9,),
        note="Differences are in pixels without distortion. Shift, rotation and scale are stated by"
        f" themselves and taken out of the rest. {ERRORS[first.errors_of]}",
    )


@REPORT.figure("previous", needs=("previous",), printed=True)
def previous_difference(run: ReportedRun) -> Plot:
    """Vectors of the run minus the release that it replaces, without shift, rotation and scale."""
    worst = max(run.previous, key=lambda found: found.largest)
    size = with_mas(worst.largest, "pix", worst.frame.pixel_mas or scale_mas(run))
    shades = " Shades are the significance of each position separately." if worst.field else ""
    return Plot(
        difference_vectors(run.previous, names=("this run", "previous")),
        "Difference from the previous release",
        f"Vectors of this run minus {worst.b.name}, at most {size}, after shift, rotation and scale"
        f" between both.{shades}",
        f"Vector diagram of the difference from the previous release, at most {size}.",
    )
