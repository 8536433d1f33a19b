"""Held-out stars compared with their prediction."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import TwoSlopeNorm
from matplotlib.patches import Rectangle

from bayesdist.diagnose.holdout.validation import HoldoutValidation
from bayesdist.report.contents import REPORT, Plot, needed
from bayesdist.report.figures.panels import chip_axes
from bayesdist.report.figures.style import CYCLE, INK, WIDTH, new_figure
from bayesdist.report.run import ReportedRun, mosaic_of
from bayesdist.report.texttable import TextTable, tabulated
from bayesdist.utils.distributions import binom_ppf
from bayesdist.utils.text import count, number

if TYPE_CHECKING:
    from bayesdist.diagnose.holdout.validation import HeldTest

_WHAT = ("u", "v, given u", "distance")
_LEAST_RANGE = 0.3  # least range of the error factor about 1, so that chance is not exaggerated
_FEWEST = 20  # stars in a region that is coloured
_MOST_TESTS = 12
_KEY = 3.0  # length of the arrow in the key, in sigma


@REPORT.table("holdout", needs=("diagnostics.holdout.coverage",))
def holdout_coverage(run: ReportedRun) -> TextTable:
    """Table of the coverage of the held-out stars along each axis."""
    held_out = needed(run.diagnostics.holdout)
    rows = [
        {
            "Axis": c.axis,
            "Within": f"{c.level:g} σ",
            "Stars": count(c.n),
            "Fraction": f"{c.value:.3f}",
            "95 % interval": f"{c.interval[0]:.3f} to {c.interval[1]:.3f}",
            "Predicted": f"{c.expected:.3f}",
        }
        for c in held_out.coverage
    ]
    note = "False matches are part of the prediction; the interval is that of independent stars."
    return tabulated("Coverage of the held-out stars", rows, words=(0, 1), note=note)


@REPORT.table("holdout", needs=("diagnostics.holdout",))
def holdout_table(run: ReportedRun) -> TextTable:
    """Table of the most informative tests."""
    stars = needed(run.diagnostics.holdout)
    shown = stars.tests[:_MOST_TESTS]
    rows = [
        {
            "Test": _question(test, stars.unit),
            "Where": test.where,
            "Stars": count(test.n),
            "Found": number(test.value, 3),
            "Predicted": number(test.expected, 3),
            "p": number(test.p_value, 2),
            "p, corrected": number(test.p_corrected, 2),
        }
        for test in shown
    ]
    note = (
        f"The {len(shown)} most telling of {len(stars.tests)} tests, all in holdout.ecsv; corrected"
        " for their number after Holm (1979)."
    )
    return tabulated("Tests of the held-out stars", rows, words=(0, 1), note=note)


def _question(test: HeldTest, unit: str) -> str:
    return {
        "offset": f"offset, largest [{unit}]" if test.is_omnibus else f"offset [{unit}]",
        "spread": "residuals / predicted",
        "distribution": "largest difference of distributions",
        "tails": "fraction of stars",
        "deviation": "deviation from other exposures",
    }[test.name]


@REPORT.figure(
    "holdout", needs=("diagnostics.holdout",), printed=lambda run: run.kind.words.prints_data
)
def holdout(run: ReportedRun) -> Plot:
    """Predictive probabilities, and residuals by region in units of their prediction."""
    stars, mosaic = needed(run.diagnostics.holdout), mosaic_of(run)
    rows, columns = (max(place[k] for place in mosaic.places) + 1 for k in (0, 1))
    aspect = max(ny / nx for nx, ny in mosaic.sizes)
    panel = min(0.75 * WIDTH / columns, 4.4)
    height = 1.9 + rows * (panel * aspect + 0.7)
    fig = new_figure(WIDTH, height)
    parts = fig.subfigures(2, 1, height_ratios=[1.9, height - 1.9], squeeze=False)
    top, bottom = parts[:, 0]
    for k, ax in enumerate(top.subplots(1, 3, sharey=True)):
        _histogram(ax, stars, k)
    grid = bottom.subplots(rows, columns, squeeze=False)
    panels = [grid[place] for place in mosaic.places]
    limit = _limit(stars)
    norm = TwoSlopeNorm(1.0, 1.0 / limit, limit)
    for k, (size, name) in enumerate(zip(mosaic.sizes, mosaic.names, strict=True)):
        drawn = _regions(panels[k], stars, k, size, norm)
        panels[k].set_title(name or "Regions")
    for ax in grid.ravel():
        ax.set_visible(ax in panels)
    bar = bottom.colorbar(drawn, ax=panels, shrink=0.9, aspect=25)
    bar.set_label("residuals / predicted [no unit]")
    n_tests = len(stars.tests)
    clause = f", {len(stars.exposures)} whole exposures among them" if stars.exposures else ""
    return Plot(
        fig,
        "Held-out stars against their prediction",
        f"{count(stars.n)} stars that the fit has not seen{clause}. Top: where each lies in its"
        " predicted distribution, false matches and the posterior's own error included; level"
        " within the band (99 % of a bin) if the prediction is right. Bottom: the residuals of"
        " each region in units of those predicted (1: as predicted), and the mean offset in its"
        f" own sigma. Of {n_tests} tests the most telling, corrected for their number:"
        f" {stars.verdict}.",
        f"Histograms of predictive probabilities and a map of normalised residuals: "
        f"{stars.verdict}.",
    )


def _histogram(ax: Axes, found: HoldoutValidation, k: int) -> None:
    counts = found.pit[k]
    bins = len(counts)
    low, high = binom_ppf([0.005, 0.995], found.n, 1 / bins) * bins / found.n
    ax.axhspan(low, high, color=CYCLE[0], alpha=0.18, lw=0)
    ax.axhline(1.0, color=INK, lw=0.8)
    ax.stairs(counts * bins / found.n, np.linspace(0, 1, bins + 1), color=CYCLE[0], lw=1.3)
    ax.set_xlim(0, 1)
    ax.set_ylim(0, max(2.0, 1.1 * float(counts.max()) * bins / found.n))
    ax.set_xlabel("predicted probability of less")
    ax.set_title(_WHAT[k])
    if k == 0:
        ax.set_ylabel("stars / predicted")


def _limit(found: HoldoutValidation) -> float:
    """Largest factor on the colour scale."""
    good = found.region_scale[found.region_n >= _FEWEST]
    far = np.exp(np.abs(np.log(good)).max()) if good.size else 1.0
    return float(np.clip(far, 1 + _LEAST_RANGE, 4.0))


def _regions(
    ax: Axes, found: HoldoutValidation, k: int, size: tuple[float, float], norm: TwoSlopeNorm
) -> PatchCollection:
    """Draw the regions of one chip: colour shows the factor, arrows the offset in sigma."""
    chips = list(dict.fromkeys(bin_.chip for bin_ in found.regions))
    mine = [
        b
        for b, bin_ in enumerate(found.regions)
        if bin_.chip == chips[k] and found.region_n[b] >= _FEWEST
    ]
    boxes = []
    for b in mine:
        x0, x1, y0, y1 = found.regions[b].limits
        boxes.append(Rectangle((x0, y0), x1 - x0, y1 - y0))
    drawn = PatchCollection(boxes, cmap="RdBu_r", norm=norm, ec="white", lw=0.6)
    drawn.set_array(found.region_scale[mine])
    ax.add_collection(drawn)
    chip_axes(ax, size)
    ax.label_outer()
    if not mine:
        return drawn
    edges = np.array([found.regions[b].limits for b in mine])
    length = 0.28 * float(np.median(edges[:, 1] - edges[:, 0])) / _KEY  # pixels of one sigma
    arrows = ax.quiver(
        edges[:, :2].mean(axis=1),
        edges[:, 2:].mean(axis=1),
        *(found.region_offset[mine].T * length),
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=0.005,
        color=INK,
        ec="white",
        lw=0.4,
    )
    if k == 0:
        ax.quiverkey(
            arrows,
            0.9,
            1.05,
            _KEY * length,
            f"offset of {_KEY:g} σ",
            labelpos="W",
            coordinates="axes",
        )
    return drawn
