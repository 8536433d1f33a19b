"""Distortion over the detector, and its uncertainty there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from bayesdist.report.contents import REPORT, Plot
from bayesdist.report.context import ReportInput
from bayesdist.report.figures.arrows import (
    Arrows,
    cross_map,
    crosses_magnification,
    sparse_step,
    vector_map,
)
from bayesdist.report.figures.fields import Grid, contour_levels, error_levels, scalar_map
from bayesdist.report.figures.panels import ChipPanels
from bayesdist.report.figures.style import nice_below
from bayesdist.report.plots.maps import BORDER, distortion_magnification
from bayesdist.report.sections.gauge import gauge_mark, gauge_of_maps
from bayesdist.report.texttable import TextTable, tabulated
from bayesdist.utils.numbers import display_scale, number, size_of, with_mas

if TYPE_CHECKING:
    from bayesdist.assess import VectorMap


@REPORT.table("maps")
def map_table(r: ReportInput) -> TextTable:
    """Table of the extremes of the uncertainty maps."""
    rows = []
    typical = max(float(np.nanmax(m.per_axis)) for c in r.chips for m in c.maps)
    for c in r.chips:
        for m in c.maps:
            sizes = {
                "Largest σ u": m.sigma_u_max,
                "Largest σ v": m.sigma_v_max,
                "Largest per axis": float(np.nanmax(m.per_axis)),
                "Median per axis": float(np.nanmedian(m.per_axis)),
                "Largest CE68": float(np.nanmax(m.circular_error(0.68))),
                "Largest CE95": float(np.nanmax(m.circular_error(0.95))),
            }
            row = {k: with_mas(v, m.unit, r.scale_mas, like=typical) for k, v in sizes.items()}
            row["At pixel"] = "({:.0f}, {:.0f})".format(*m.position_of_max)
            if m is not c.formal_map:
                row = {k: r.marked(text) for k, text in row.items()}
            whose = {"Chip, solution": f"{c.chip.name}, {m.kind}"}
            rows.append((whose if r.several else {"Solution": m.kind}) | row)
    first = r.chips[0].formal_map
    when = "" if first.epoch is None else f", epoch {first.epoch:.2f}"
    which = "each chip" if r.several else f"chip {first.chip}"
    return tabulated(
        f"Uncertainty of the position, 1 σ, {which}{when}{gauge_mark(r)}",
        rows,
        note="Per axis: rms of σ u and σ v. CE68, CE95: radii of the circles that hold 68 and 95 %."
        f" {gauge_of_maps(r)}".rstrip(),
    )


@REPORT.figure("maps", printed=True)
def uncertainty_radius(r: ReportInput) -> Plot:
    """Uncertainty per axis, rms of sigma_u and sigma_v, all maps in one colour scale."""
    maps = [m for c in r.chips for m in c.maps]
    scale = display_scale(r.unit, max(float(np.nanmax(m.per_axis)) for m in maps))
    grids = [Grid(m.x, m.y, m.per_axis * scale.factor, m.position_of_max) for m in maps]
    panels = ChipPanels(r.mosaic, len(r.chips[0].maps), colorbar=True)
    panels.frame()
    kinds = [(k, m.kind) for k, c in enumerate(r.chips) for m in c.maps]
    scalar_map(
        panels,
        grids,
        [
            panels.title(k, f"{kind}: {low} to {high}", ", ")
            for (k, kind), (low, high) in zip(kinds, map(_range, grids), strict=True)
        ],
        levels=error_levels(np.concatenate([g.values.ravel() for g in grids])),
        label=f"per axis (1 σ) [{scale.unit}]",
    )
    figure = panels.figure
    text = (
        "Uncertainty per axis, the rms of σ u and σ v, ringed where it is largest. The circle that"
        " holds 68 % has 1.51 times this as its radius where both axes are alike, that of 95 %"
        " 2.45 times."
    )
    if r.selfcal is not None:
        text += (
            " That of relative positions is the same in any gauge of shift, rotation and scale (and"
            " skew, where all exposures have one roll angle); the other is that of the run's gauge."
        )
        return Plot(figure, "Uncertainty over the detector", text, f"Contour maps. {text}")
    pairs = [(c.formal_map, c.posterior_map) for c in r.chips]
    ratios = [p.radius / f.radius for f, p in pairs if p is not None]
    if ratios:
        low, high = (number(float(end(ratios))) for end in (np.nanmin, np.nanmax))
        text += (
            f" The posterior's is {low} to {high} times the formal one;"
            " above 1, the formal errors of least squares with rejection are too small."
        )
    return Plot(figure, "Uncertainty over the detector", text, f"Contour maps. {text}")


def _range(grid: Grid) -> tuple[str, str]:
    """Smallest and largest value as text."""
    return number(float(np.nanmin(grid.values))), number(float(np.nanmax(grid.values)))


@REPORT.figure("maps", printed=True)
def distortion(r: ReportInput) -> Plot:
    """Vectors from each array position to where the distortion puts it.

    As section 4 of the WISE distortion report, with the zeroth order suppressed.
    """
    v, where = _longest(r, "displacement")
    notes = {c.chip.name: c.displacement.part_note for c in r.chips}
    note = v.part_note
    if len(set(notes.values())) > 1:
        note = "; ".join(f"{name} {text}" for name, text in notes.items())
    own = " Each chip is compared with its own array: gap and rotation between chips are not shown."
    return Plot(
        _flow(r, [c.displacement for c in r.chips]),
        "Distortion, zeroth order suppressed",
        f"Vectors run from the array position to where the distortion puts it, {note}; the"
        f" largest is {r.length(v.length_max)} at {where}, ringed."
        f"{own if r.several else ''}",
        f"Vector-flow diagram of the distortion, largest vector {r.length(v.length_max)}.",
    )


@REPORT.figure("maps")
def distortion_non_linear(r: ReportInput) -> Plot:
    """Vectors of the non-linear part, as Figure 4.1 of the ACS handbook."""
    v, where = _longest(r, "non_linear")
    return Plot(
        _flow(r, [c.non_linear for c in r.chips]),
        "Distortion, non-linear part",
        f"Only {v.part_note}: what remains beyond shift, scale, rotation and skew, at most"
        f" {r.length(v.length_max)} at {where}, ringed.",
        f"Vector diagram of the non-linear part, largest vector {r.length(v.length_max)}.",
    )


def _flow(r: ReportInput, vectors: Sequence[VectorMap]) -> Figure:
    """Vectors along x and y of each chip, in its pixels, whatever the unit of u and v."""
    chips, sizes = [Arrows.of_map(v) for v in vectors], [c.chip.size for c in r.chips]
    lengths = [float(np.hypot(*v.on_detector).max()) for v in vectors]
    M = distortion_magnification(vectors)
    reach = max(one.reach(M, size) for one, size in zip(chips, sizes, strict=True))
    panels = ChipPanels(r.mosaic)
    panels.frame(reach + BORDER * r.mosaic.longest_side)
    titles = [
        panels.title(k, f"largest {size_of(length, digits=4)}") for k, length in enumerate(lengths)
    ]
    vector_map(panels, chips, titles, magnification=M, key=nice_below(max(lengths) / 1.5))
    return panels.figure


def _longest(r: ReportInput, which: str) -> tuple[VectorMap, str]:
    """Vectors of the chip where the longest one is, and its position in words."""
    worst = max(r.chips, key=lambda c: getattr(c, which).length_max)
    vectors: VectorMap = getattr(worst, which)
    return vectors, f"pixel {r.position(vectors.position_of_max, worst.chip.number)}"


@REPORT.figure("maps")
def formal_uncertainty(r: ReportInput) -> Plot:
    """Four vectors from each position, to (±sigma_u, ±sigma_v).

    As section 6 of the WISE distortion report, which draws them 2000 times larger than the
    detector.
    """
    maps = [m for c in r.chips for m in c.maps]
    largest = max(m.radius_max for m in maps)
    widest = max(max(m.sigma_u_max, m.sigma_v_max) for m in maps)
    every = max(sparse_step(maps), 2 if r.several else 1)  # panels of several chips are small
    M = crosses_magnification(maps, every)
    panels = ChipPanels(r.mosaic, len(r.chips[0].maps))
    panels.frame(M * widest + BORDER * r.mosaic.longest_side)
    titles = [
        panels.title(
            k, f"{m.kind}, largest {size_of(float(np.nanmax(m.per_axis)), m.unit)} per axis", ", "
        )
        for k, c in enumerate(r.chips)
        for m in c.maps
    ]
    cross_map(panels, maps, titles, magnification=M, key=nice_below(largest), every=every)
    by_kind = [
        max(maps, key=lambda m: m.radius_max)
        for maps in zip(*(c.maps for c in r.chips), strict=True)
    ]
    found = " and ".join(f"{r.length(float(np.nanmax(m.per_axis)))} ({m.kind})" for m in by_kind)
    return Plot(
        panels.figure,
        "Uncertainty diagram",
        "From each position four vectors to all combinations of ±1 σ in u and v, enlarged as"
        f" stated above the panels; the largest error per axis is {found}.",
        f"Crosses of ±1 sigma over the detector; largest per axis {found}.",
    )


@REPORT.figure("maps")
def pixel_area(r: ReportInput) -> Plot:
    """Contours of the pixel area relative to that at the reference pixel, in percent.

    As Figure 4.5 of the ACS handbook, which gives the same ratio without subtracting one.
    """
    areas = [c.area for c in r.chips]
    grids = [Grid(a.x, a.y, 100.0 * (a.area - 1.0)) for a in areas]
    panels = ChipPanels(r.mosaic, colorbar=True)
    panels.frame()
    scalar_map(
        panels,
        grids,
        [
            panels.title(k, f"relative area {number(a.area.min(), 6)} to {number(a.area.max(), 6)}")
            for k, a in enumerate(areas)
        ],
        levels=contour_levels(np.concatenate([g.values.ravel() for g in grids])),
        label="pixel area − area at reference pixel [%]",
        labelled=True,
    )
    low, high = min(a.area.min() for a in areas), max(a.area.max() for a in areas)
    sigma = max(float(a.sigma.max()) for a in areas)
    own, between = "", ""
    if r.several:
        own = " of each chip"
        first, *others = r.chips
        ratios = ", ".join(
            f"{c.area.reference_area / first.area.reference_area:.5f} ({c.chip.name})"
            for c in others
        )
        between = (
            f" The reference pixels themselves cover, relative to that of {first.chip.name}:"
            f" {ratios}."
        )
    return Plot(
        panels.figure,
        "Pixel area",
        f"Relative to the reference pixel{own} the area runs from {low:.5f} to"
        f" {high:.5f}, known to {number(sigma, 2)} at worst: flat-fielded"
        f" point-source photometry is to be multiplied by it.{between}",
        "Contour map of the relative pixel area.",
    )


@REPORT.figure("maps", printed=True)
def pixel_scale(r: ReportInput) -> Plot:
    """Map of the pixel scale, the square root of the area of each pixel."""
    areas = [c.area for c in r.chips]
    in_pixels = r.unit == "pix" and r.scale_mas is None
    factor = r.scale_mas or 1.0 if r.unit == "pix" else 1.0
    values = [factor * np.sqrt(a.area * a.reference_area) for a in areas]
    scale = display_scale("mas" if r.unit == "pix" else r.unit, max(float(v.max()) for v in values))
    unit = "reference pix" if in_pixels else scale.unit
    by = 1.0 if in_pixels else scale.factor
    grids = [Grid(a.x, a.y, by * v) for a, v in zip(areas, values, strict=True)]
    panels = ChipPanels(r.mosaic, colorbar=True)
    panels.frame()
    scalar_map(
        panels,
        grids,
        [
            panels.title(k, f"{g.values.min():.6g} to {g.values.max():.6g}")
            for k, g in enumerate(grids)
        ],
        levels=contour_levels(np.concatenate([g.values.ravel() for g in grids])),
        label=f"pixel scale [{unit}/pix]",
        labelled=True,
    )
    low = min(float(g.values.min()) for g in grids)
    high = max(float(g.values.max()) for g in grids)
    return Plot(
        panels.figure,
        "Pixel scale",
        f"Side of the square that has the area of the pixel, from {low:.6g} to {high:.6g} {unit}:"
        " the geometric mean of the scales along both axes. With u and v in pixels it rests on the"
        " size of a pixel that the configuration gives.",
        f"Contour map of the pixel scale, from {low:.6g} to {high:.6g} {unit}.",
    )
