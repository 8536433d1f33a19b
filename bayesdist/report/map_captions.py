"""Words of the figures that show the distortion and its errors over the detector."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bayesdist.report.caption import Caption
from bayesdist.report.context import ReportInput
from bayesdist.report.numbers import number

if TYPE_CHECKING:
    from bayesdist.assess import VectorMap

__all__ = [
    "area_caption",
    "flow_caption",
    "formal_caption",
    "non_linear_caption",
    "radius_caption",
]


def flow_caption(inputs: ReportInput) -> Caption:
    v, where = _longest(inputs, "displacement")
    notes = {c.chip.name: c.displacement.part_note for c in inputs.chips}
    note = v.part_note
    if len(set(notes.values())) > 1:
        note = "; ".join(f"{name} {text}" for name, text in notes.items())
    return Caption(
        "Distortion, zeroth order suppressed",
        f"Vectors run from the array position to where the distortion puts it, {note}; the"
        f" largest is {inputs.length(v.length_max)} at {where}, ringed."
        f"{_suppressed(inputs)}",
        f"Vector-flow diagram of the distortion, largest vector {inputs.length(v.length_max)}.",
    )


def non_linear_caption(inputs: ReportInput) -> Caption:
    v, where = _longest(inputs, "non_linear")
    return Caption(
        "Distortion, non-linear part",
        f"Only {v.part_note}: what remains beyond shift, scale, rotation and skew, at most"
        f" {inputs.length(v.length_max)} at {where}, ringed.",
        f"Vector diagram of the non-linear part, largest vector {inputs.length(v.length_max)}.",
    )


def _longest(inputs: ReportInput, which: str) -> tuple[VectorMap, str]:
    """The vectors of the chip where the longest one is, and its place in words."""
    worst = max(inputs.chips, key=lambda c: getattr(c, which).length_max)
    vectors: VectorMap = getattr(worst, which)
    x, y = vectors.position_of_max
    return vectors, f"pixel ({x:.0f}, {y:.0f}){inputs.on_chip(worst.chip)}"


def _suppressed(inputs: ReportInput) -> str:
    if not inputs.several:
        return ""
    return (
        " Each chip is compared with its own array: gap and rotation between the chips are not"
        " shown. All panels have one scale."
    )


def formal_caption(inputs: ReportInput) -> Caption:
    by_kind = [
        max(maps, key=lambda m: m.radius_max)
        for maps in zip(*(c.maps for c in inputs.chips), strict=True)
    ]
    found = " and ".join(f"{inputs.length(m.radius_max)} ({m.kind})" for m in by_kind)
    return Caption(
        "Formal-uncertainty diagram",
        "From each place four vectors to all combinations of ±1 σ in u and ±1 σ in v, enlarged as"
        f" stated above the panels; the largest radius is {found}.",
        f"Crosses of ±1 sigma over the detector; largest radius {found}.",
    )


def radius_caption(inputs: ReportInput) -> Caption:
    text = "Radial uncertainty hypot(σ u, σ v), its largest place ringed."
    if inputs.selfcal is not None:
        text += (
            " That of relative positions is the same whatever fixes place, rotation and scale (and"
            " skew, where all exposures have one roll angle); the other is that of the run's gauge."
        )
        return Caption("Uncertainty over the detector", text, f"Contour maps. {text}")
    pairs = [(c.formal_map, c.posterior_map) for c in inputs.chips]
    ratios = [p.radius / f.radius for f, p in pairs if p is not None]
    if ratios:
        low, high = (number(float(end(ratios))) for end in (np.min, np.max))
        text += (
            f" The posterior's is {low} to {high} times the formal one;"
            " above 1, least squares with rejection is too sure of itself."
        )
    return Caption("Uncertainty over the detector", text, f"Contour maps. {text}")


def area_caption(inputs: ReportInput) -> Caption:
    areas = [c.area for c in inputs.chips]
    low, high = min(a.area.min() for a in areas), max(a.area.max() for a in areas)
    sigma = max(float(a.sigma.max()) for a in areas)
    own, between = "", ""
    if inputs.several:
        own = " of each chip"
        first, *others = inputs.chips
        ratios = ", ".join(
            f"{c.area.reference_area / first.area.reference_area:.5f} ({c.chip.name})"
            for c in others
        )
        between = (
            f" The reference pixels themselves cover, relative to that of {first.chip.name}:"
            f" {ratios}."
        )
    return Caption(
        "Pixel area",
        f"Relative to the reference pixel{own} the area runs from {low:.5f} to"
        f" {high:.5f}, known to {number(sigma, 2)} at worst: flat-fielded"
        f" point-source photometry is to be multiplied by it.{between}",
        "Contour map of the relative pixel area.",
    )
