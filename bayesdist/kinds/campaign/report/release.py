"""Released files, and the alignment of two exposures with the old and the new files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayesdist.diagnose.overlap import OverlapTest
from bayesdist.plugin import mission_objects
from bayesdist.report.contents import REPORT, Plot, needed
from bayesdist.report.figures.arrows import Arrows, magnification_of, vector_map
from bayesdist.report.figures.panels import Panels
from bayesdist.report.figures.style import WIDTH, new_figure, nice_below
from bayesdist.report.run import ReportedRun
from bayesdist.report.texttable import TextTable, tabulated
from bayesdist.utils.text import count, number, size_of

MIN_STARS_PER_CELL = 5  # of a cell that is drawn and counted


@REPORT.table("campaign-release")
def released_files(run: ReportedRun) -> TextTable | None:
    """Table of files for pipelines with their dates; None if no files were written."""
    releases = mission_objects(lambda mission: mission.releases).values()
    kinds = {kind: text for release in releases for kind, text in release.kinds.items()}
    files = [p for p in run.summary.get("products") or () if p["kind"] in kinds]
    if not files:
        return None
    release = run.configuration.get("products", {}).get("release") or {}
    years = {p["name"]: p["years"] for p in release.get("period", ())}
    rows = []
    for p in files:
        period = p.get("period")
        dates = "all" if period is None else "{:g} to {:g}".format(*years.get(period, (0, 0)))
        lost = max((abs(loss["mas"]) for loss in p.get("lost", ())), default=None)
        rows.append(
            {
                "File": p["path"],
                "What it is": kinds[p["kind"]],
                "Dates": dates,
                "Drift that it cannot hold, at most [mas]": number(lost, 2),
            }
        )
    return tabulated("Released files", rows, words=(0, 1, 2))


@REPORT.figure("campaign-release", needs=("diagnostics.overlap",))
def overlap(run: ReportedRun) -> Plot:
    """Residuals between two exposures after shift, rotation and scale: old files and new.

    Figures 27 and 28 of Kozhurina-Platais et al. (2015).
    """
    t = needed(run.diagnostics.overlap)
    states = {"old": (t.binned_old, t.old), "new": (t.binned_new, t.new)}
    panels, arrows, titles, largest = _panels(t), [], [], {}
    for state, (binned, test_result) in states.items():
        cells = Arrows.of_cells(binned, MIN_STARS_PER_CELL)
        largest[state] = float(cells.length.max(initial=0.0))
        x, y = cells.x - 0.5 + t.corner[0], cells.y - 0.5 + t.corner[1]
        arrows.append(replace(cells, x=x, y=y, clear=np.ones(cells.x.size, bool)))
        name = "known distortion" if state == "old" else "this run"
        rms = float(np.sqrt(np.mean(test_result.rms**2)))
        titles.append(f"{name}: largest {largest[state]:.3f}, rms {rms:.3f} pix")
    length = arrows[0].length
    typical = float(np.quantile(length, 0.95)) if length.size else 1.0
    vector_map(
        panels,
        arrows,
        titles,
        magnification=magnification_of(1.1 * arrows[0].step, typical),
        key=nice_below(typical),
        pad=20,
    )
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
        f" {MIN_STARS_PER_CELL} stars or more. Left: through the known distortion that the matching"
        " started from; right: through tables, polynomial and drift of this run, without anything"
        f" fitted to these two exposures. Largest cell {size_of(largest['old'])} and"
        f" {size_of(largest['new'])}; rms of an axis over the stars"
        f" {size_of(old)} and {size_of(new)}."
    )
    if t.with_motions:
        text += " The catalogue's proper motions between the two dates are taken out."
    text += f" Pixels of {t.pixel_mas:g} mas; both panels have one scale."
    return Plot(
        panels.figure,
        "Alignment of two exposures",
        text,
        "Residual vectors between two exposures, with a pattern on the left and little on the"
        f" right: rms {size_of(old)} and {size_of(new)}.",
    )


def _panels(t: OverlapTest) -> Panels:
    """Panels of the area covered by both exposures."""
    size = np.ptp(t.new.position, axis=0)
    middle, half = np.array(t.corner) + size / 2, 0.56 * size
    aspect = float(np.clip(size[1] / size[0], 0.5, 1.6))
    figure = new_figure(WIDTH, 0.5 * WIDTH * aspect + 0.9, layout="compressed")
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for ax in axes:
        ax.set_aspect("equal")
        ax.set_xlim(middle[0] - half[0], middle[0] + half[0])
        ax.set_ylim(middle[1] - half[1], middle[1] + half[1])
        ax.set_xlabel(r"$\xi$ [pix]")
    axes[0].set_ylabel(r"$\eta$ [pix]")
    return Panels(figure, [[ax] for ax in axes], ("", ""))
