"""Distortion over the detector, and its uncertainty."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from bayesdist.assess.solution import chip_frames
from bayesdist.assess.vectors import diagram_vectors
from bayesdist.report.contents import REPORT, Plot
from bayesdist.report.figures.arrows import (
    Arrows,
    cell_magnification,
    cross_map,
    crosses_magnification,
    spacing,
    sparse_step,
    vector_map,
)
from bayesdist.report.figures.fields import Grid, contour_levels, error_levels, scalar_map
from bayesdist.report.figures.panels import ChipPanels, FocalPlane, Panels, overlap
from bayesdist.report.figures.style import nice_below
from bayesdist.report.plots.maps import BORDER, KEY_PAD
from bayesdist.report.run import (
    ReportedRun,
    gauge_mark,
    gauge_of_maps,
    has_several_chips,
    length_text,
    marked,
    mosaic_of,
    position_text,
    scale_mas,
    shown_maps,
)
from bayesdist.report.texttable import TextTable, tabulated
from bayesdist.utils.text import display_scale, number, size_of, with_mas

if TYPE_CHECKING:
    from bayesdist.assess import VectorMap

MOST_PANELS = 4  # largest number of chips with separate panels; more share one focal plane
MOST_ALONG = 34  # vectors along the longer side of a focal plane; more would overlap


@REPORT.table("maps")
def map_table(run: ReportedRun) -> TextTable:
    """Table of the extremes of the uncertainty maps."""
    rows = []
    shown, formal = shown_maps(run), run.evaluation.formal
    typical = max(float(np.nanmax(m.per_axis)) for maps in shown for m in maps)
    for chip, maps in zip(run.model.chips, shown, strict=True):
        for m in maps:
            sizes = {
                "Largest σ u": m.sigma_u_max,
                "Largest σ v": m.sigma_v_max,
                "Largest per axis": float(np.nanmax(m.per_axis)),
                "Median per axis": float(np.nanmedian(m.per_axis)),
                "Largest CE68": float(np.nanmax(m.circular_error(0.68))),
                "Largest CE95": float(np.nanmax(m.circular_error(0.95))),
            }
            row = {k: with_mas(v, m.unit, scale_mas(run), like=typical) for k, v in sizes.items()}
            row["At pixel"] = "({:.0f}, {:.0f})".format(*m.position_of_max)
            if m not in formal:
                row = {k: marked(run, text) for k, text in row.items()}
            whose = {"Chip, solution": f"{chip.name}, {m.kind}"}
            rows.append((whose if has_several_chips(run) else {"Solution": m.kind}) | row)
    first = formal[0]
    when = "" if first.epoch is None else f", epoch {first.epoch:.2f}"
    chip_words = "each chip" if has_several_chips(run) else f"chip {first.chip}"
    return tabulated(
        f"Uncertainty of the position, 1 σ, {chip_words}{when}{gauge_mark(run)}",
        rows,
        note="Per axis: rms of σ u and σ v. CE68, CE95: radii of the circles that hold 68 and 95 %."
        f" {gauge_of_maps(run)}".rstrip(),
    )


@REPORT.figure("maps", printed=True)
def uncertainty_radius(run: ReportedRun) -> Plot:
    """Uncertainty per axis, rms of sigma_u and sigma_v, all maps in one colour scale."""
    shown = shown_maps(run)
    maps = [m for of_chip in shown for m in of_chip]
    scale = display_scale(run.model.unit, max(float(np.nanmax(m.per_axis)) for m in maps))
    grids = [Grid(m.x, m.y, m.per_axis * scale.factor, m.position_of_max) for m in maps]
    kinds = [m.kind for m in shown[0]]
    panels = map_panels(run, len(kinds))

    def title(kind: str, low: float, high: float) -> str:
        return f"{kind}: {number(low)} to {number(high)}"

    scalar_map(
        panels,
        grids,
        map_titles(panels, grids, [partial(title, kind) for kind in kinds], ", "),
        levels=error_levels(np.concatenate([g.values.ravel() for g in grids])),
        label=f"per axis (1 σ) [{scale.unit}]",
    )
    figure = panels.figure
    text = (
        "Uncertainty per axis, the rms of σ u and σ v, ringed where it is largest. The circle that"
        " holds 68 % has 1.51 times this as its radius where both axes are alike, that of 95 %"
        " 2.45 times."
    )
    if run.kind.words.relative_map:
        text += run.kind.words.relative_map
        return Plot(figure, "Uncertainty over the detector", text, f"Contour maps. {text}")
    ratios = [posterior.radius / formal.radius for formal, posterior in shown]
    low, high = (number(float(end(ratios))) for end in (np.nanmin, np.nanmax))
    text += (
        f" The posterior's is {low} to {high} times the formal one;"
        " above 1, the formal errors of least squares with rejection are too small."
    )
    return Plot(figure, "Uncertainty over the detector", text, f"Contour maps. {text}")


@REPORT.figure("maps", printed=True)
def distortion(run: ReportedRun) -> Plot:
    """Vectors from each array position to where the distortion puts it.

    As section 4 of WSDC D-T033, with the zeroth order suppressed.
    """
    vectors = _vectors(run, "no_constant")
    v, place = _longest(run, vectors)
    notes = {
        chip.name: of_chip.part_note for chip, of_chip in zip(run.model.chips, vectors, strict=True)
    }
    note = v.part_note
    if len(set(notes.values())) > 2:
        note = "relative to the best similarity of each chip about its reference pixel"
    elif len(set(notes.values())) > 1:
        note = "; ".join(f"{name} {text}" for name, text in notes.items())
    own_array_note = (
        " Each chip is compared with its own array: gap and rotation between chips are not shown."
    )
    return Plot(
        _flow(run, vectors),
        "Distortion, zeroth order suppressed",
        f"Vectors run from the array position to where the distortion puts it, {note}; the"
        f" largest is {length_text(run, v.length_max)} at {place}, ringed."
        f"{own_array_note if has_several_chips(run) else ''}",
        f"Vector-flow diagram of the distortion, largest vector {length_text(run, v.length_max)}.",
    )


@REPORT.figure("maps")
def pixel_area(run: ReportedRun) -> Plot:
    """Contours of the pixel area relative to that at the reference pixel, in percent.

    Handbooks of cameras give the same ratio without subtracting one.
    """
    areas = run.evaluation.areas
    grids = [Grid(a.x, a.y, 100.0 * (a.area - 1.0)) for a in areas]
    panels = map_panels(run)
    scalar_map(
        panels,
        grids,
        map_titles(
            panels,
            grids,
            [
                lambda low, high: (
                    f"relative area {number(1 + low / 100, 6)} to {number(1 + high / 100, 6)}"
                )
            ],
        ),
        levels=contour_levels(np.concatenate([g.values.ravel() for g in grids])),
        label="pixel area − area at reference pixel [%]",
        labelled=True,
    )
    low, high = min(a.area.min() for a in areas), max(a.area.max() for a in areas)
    sigma = max(float(a.sigma.max()) for a in areas)
    of_chip, between = "", ""
    if has_several_chips(run):
        of_chip = " of each chip"
        (first, area), *others = zip(run.model.chips, areas, strict=True)
        ratios = ", ".join(
            f"{other.reference_area / area.reference_area:.5f} ({chip.name})"
            for chip, other in others
        )
        between = (
            f" The reference pixels themselves cover, relative to that of {first.name}: {ratios}."
        )
    return Plot(
        panels.figure,
        "Pixel area",
        f"Relative to the reference pixel{of_chip} the area runs from {low:.5f} to"
        f" {high:.5f}, known to {number(sigma, 2)} at worst: flat-fielded"
        f" point-source photometry is to be multiplied by it.{between}",
        "Contour map of the relative pixel area.",
    )


@REPORT.figure("maps", printed=True)
def pixel_scale(run: ReportedRun) -> Plot:
    """Map of the pixel scale, the square root of the area of each pixel."""
    areas = run.evaluation.areas
    in_pixels = run.model.unit == "pix" and scale_mas(run) is None
    factor = scale_mas(run) or 1.0 if run.model.unit == "pix" else 1.0
    values = [factor * np.sqrt(a.area * a.reference_area) for a in areas]
    scale = display_scale(
        "mas" if run.model.unit == "pix" else run.model.unit, max(float(v.max()) for v in values)
    )
    unit = "reference pix" if in_pixels else scale.unit
    by = 1.0 if in_pixels else scale.factor
    grids = [Grid(a.x, a.y, by * v) for a, v in zip(areas, values, strict=True)]
    panels = map_panels(run)
    scalar_map(
        panels,
        grids,
        map_titles(panels, grids, [lambda low, high: f"{low:.6g} to {high:.6g}"]),
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


@REPORT.figure("maps")
def distortion_non_linear(run: ReportedRun) -> Plot:
    """Vectors of the non-linear part."""
    vectors = _vectors(run, "non_linear")
    v, place = _longest(run, vectors)
    return Plot(
        _flow(run, vectors),
        "Distortion, non-linear part",
        f"Only {v.part_note}: what remains beyond shift, scale, rotation and skew, at most"
        f" {length_text(run, v.length_max)} at {place}, ringed.",
        f"Vector diagram of the non-linear part, largest vector {length_text(run, v.length_max)}.",
    )


def map_panels(run: ReportedRun, maps: int = 1, *, colorbar: bool = True) -> Panels:
    """Panels of maps: one for each chip, or one focal plane if there are many."""
    frames = chip_frames(run.posterior, epoch=run.evaluation.maps[0].epoch)
    outlines = [
        frame.outline(chip.size) for frame, chip in zip(frames, run.model.chips, strict=True)
    ]
    if len(run.model.chips) <= MOST_PANELS or overlap(outlines):
        panels = ChipPanels(mosaic_of(run), maps, colorbar=colorbar)
        panels.frame()
        return panels
    names = [chip.name or f"chip {chip.number}" for chip in run.model.chips]
    border = BORDER * float(np.ptp(np.concatenate(outlines), axis=0).max())
    look: dict[str, Any] = {"frames": frames, "margin": border, "colorbar": colorbar}
    return FocalPlane(outlines, names, maps=maps, **look)


def map_titles(
    panels: Panels,
    grids: Sequence[Grid],
    texts: Sequence[Callable[[float, float], str]],
    joined: str = ": ",
) -> list[str]:
    """Titles for panels of `map_panels`, which state the extremes of each map.

    `grids`: maps of the first chip, followed by those of the next one. `texts`: functions that make
    a text from the lowest and the highest value of each map.
    """
    n = len(texts)
    if isinstance(panels, FocalPlane):
        values = [np.concatenate([g.values.ravel() for g in grids[k::n]]) for k in range(n)]
        return [
            text(float(np.nanmin(v)), float(np.nanmax(v)))
            for text, v in zip(texts, values, strict=True)
        ]
    return [
        panels.title(
            k // n, texts[k % n](float(np.nanmin(g.values)), float(np.nanmax(g.values))), joined
        )
        for k, g in enumerate(grids)
    ]


def _flow(run: ReportedRun, vectors: Sequence[VectorMap]) -> Figure:
    """Draw the vectors of all chips in the focal plane, in pixels for any unit of u and v.

    Each chip has a separate panel if the solution does not separate the chips on the sky.
    """
    lengths = [float(np.hypot(*v.on_detector).max()) for v in vectors]
    frames = chip_frames(run.posterior, epoch=run.evaluation.maps[0].epoch)
    outlines = [
        frame.outline(chip.size) for frame, chip in zip(frames, run.model.chips, strict=True)
    ]
    apart = not overlap(outlines)
    step = _every(vectors, np.ptp(np.concatenate(outlines), axis=0).max()) if apart else 1
    chips = [Arrows.of_map(v, step) for v in vectors]
    M = cell_magnification(min(arrows.step for arrows in chips), max(lengths))
    key = nice_below(max(lengths) / 1.5)
    border = BORDER * mosaic_of(run).longest_side
    look: dict[str, Any] = {"magnification": M, "key": key, "colored": True}
    if not apart:
        reach = max(
            arrows.reach(M, chip.size) for arrows, chip in zip(chips, run.model.chips, strict=True)
        )
        separate = ChipPanels(mosaic_of(run), colorbar=True)
        separate.frame(reach + border)
        titles = [
            separate.title(k, f"largest {size_of(length, digits=4)}")
            for k, length in enumerate(lengths)
        ]
        vector_map(separate, chips, titles, **look)
        return separate.figure
    worst = int(np.argmax(lengths))
    placed = chips
    if has_several_chips(run):
        placed = [
            arrows.placed(frame, ringed=k == worst)
            for k, (arrows, frame) in enumerate(zip(chips, frames, strict=True))
        ]
    ends = [np.stack([a.x + M * a.du, a.y + M * a.dv], axis=1) for a in placed]
    corners = np.concatenate(outlines)
    beyond = [
        corners.min(axis=0) - np.concatenate(ends).min(axis=0),
        np.concatenate(ends).max(axis=0) - corners.max(axis=0),
    ]
    names = [chip.name or f"chip {chip.number}" for chip in run.model.chips]
    plane = FocalPlane(
        outlines, names, margin=max(float(np.max(beyond)), 0.0) + border, colorbar=True
    )
    whose = f"{names[worst]}, " if has_several_chips(run) else ""
    vector_map(
        plane, placed, [f"{whose}largest {size_of(lengths[worst], digits=4)}"], pad=KEY_PAD, **look
    )
    return plane.figure


def _every(vectors: Sequence[VectorMap], extent: float) -> int:
    """Smallest additional step of the grids that leaves few enough vectors in a focal plane."""
    step = min(spacing(v.x, v.y) for v in vectors)
    steps = math.gcd(*(len(a) - 1 for v in vectors for a in (v.x, v.y)))
    divisors = [k for k in range(1, steps + 1) if steps % k == 0]
    return next((k for k in divisors if extent / (k * step) <= MOST_ALONG), divisors[-1])


def _vectors(run: ReportedRun, part: str) -> tuple[VectorMap, ...]:
    """Vectors of the distortion of each chip; for `part` see `diagram_vectors`."""
    epoch = run.evaluation.settings.epoch
    return tuple(
        diagram_vectors(run.solution, chip, part=part, epoch=epoch) for chip in run.model.chips
    )


def _longest(run: ReportedRun, vectors: Sequence[VectorMap]) -> tuple[VectorMap, str]:
    """Vectors of the chip with the longest vector, and the position of that vector as text."""
    k = max(range(len(vectors)), key=lambda k: vectors[k].length_max)
    place = position_text(run, vectors[k].position_of_max, run.model.chips[k].number)
    return vectors[k], f"pixel {place}"


@REPORT.figure("maps", when=lambda run: len(run.model.chips) <= MOST_PANELS)
def formal_uncertainty(run: ReportedRun) -> Plot:
    """Four vectors from each position, to (±sigma_u, ±sigma_v).

    As section 6 of WSDC D-T033, which draws them 2000 times larger than the
    detector.
    """
    shown = shown_maps(run)
    maps = [m for of_chip in shown for m in of_chip]
    largest = max(m.radius_max for m in maps)
    widest = max(max(m.sigma_u_max, m.sigma_v_max) for m in maps)
    step = max(
        sparse_step(maps), 2 if has_several_chips(run) else 1
    )  # panels of several chips are small
    M = crosses_magnification(maps, step)
    panels = ChipPanels(mosaic_of(run), len(shown[0]))
    panels.frame(M * widest + BORDER * mosaic_of(run).longest_side)
    titles = [
        panels.title(
            k, f"{m.kind}, largest {size_of(float(np.nanmax(m.per_axis)), m.unit)} per axis", ", "
        )
        for k, of_chip in enumerate(shown)
        for m in of_chip
    ]
    cross_map(panels, maps, titles, magnification=M, key=nice_below(largest), every=step)
    by_kind = [max(of_kind, key=lambda m: m.radius_max) for of_kind in zip(*shown, strict=True)]
    largest_errors = " and ".join(
        f"{length_text(run, float(np.nanmax(m.per_axis)))} ({m.kind})" for m in by_kind
    )
    return Plot(
        panels.figure,
        "Uncertainty diagram",
        "From each position four vectors to all combinations of ±1 σ in u and v, enlarged as"
        f" stated above the panels; the largest error per axis is {largest_errors}.",
        f"Crosses of ±1 sigma over the detector; largest per axis {largest_errors}.",
    )
