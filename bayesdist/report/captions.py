"""The sentence under each figure that says what to see, and the words in place of the picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bayesdist.report.caption import Caption
from bayesdist.report.context import ReportInput
from bayesdist.report.holdout import holdout_caption
from bayesdist.report.horizon import horizon_caption
from bayesdist.report.numerals import count, number, percent
from bayesdist.report.periods import period_caption
from bayesdist.report.scales import with_mas
from bayesdist.report.vectors import CHANCE, significant_cells

if TYPE_CHECKING:
    from bayesdist.assess import VectorMap

__all__ = ["SECTIONS", "Caption", "caption"]

SECTIONS: dict[str, tuple[str, ...]] = {
    "holdout": ("holdout",),
    "data": ("residuals_by_magnitude",),
    "fit": ("residual_histogram", "residual_vectors"),
    "outliers": ("outliers_corner",),
    "coefficients": ("coefficients_corner", "traces"),
    "maps": (
        "distortion",
        "distortion_non_linear",
        "formal_uncertainty",
        "uncertainty_radius",
        "pixel_area",
    ),
    "periods": ("period_differences",),
    "budget": ("budget_terms", "budget_dominating"),
    "margins": ("margins", "horizon"),
}


def caption(name: str, inputs: ReportInput) -> Caption:
    """Words of one of the figures in `SECTIONS`."""
    return _WRITERS[name](inputs)


def _length(value: float, inputs: ReportInput) -> str:
    return with_mas(value, inputs.unit, inputs.scale_mas)


def _sampled(inputs: ReportInput) -> str:
    return f" Drawn from {inputs.sample}." if inputs.sample else ""


def _by_magnitude(inputs: ReportInput) -> Caption:
    text = "Residuals grow towards faint stars; colour counts stars."
    if inputs.magnitude_errors is not None:
        text += (
            " The lines are ±1 σ as assigned to each magnitude:"
            " about two thirds of the stars lie between them."
        )
    text += _sampled(inputs)
    return Caption(
        "Residuals against magnitude",
        text,
        "Two density plots of the residuals in u and v against magnitude, widening to faint stars.",
    )


def _histogram(inputs: ReportInput) -> Caption:
    if inputs.posterior is None:
        text = (
            "The line is what the quoted errors alone predict;"
            " stars above it in the wings are outliers."
        )
    else:
        text = (
            "The line is the fitted mixture summed over the stars' own errors, not a fit to the"
            " bars: it should follow them in the core (top) and in the wings (bottom, logarithmic)."
        )
        if inputs.posterior.mixture.model != "none":
            text += " The dashed part is false matches."
    text += _sampled(inputs)
    return Caption(
        "Residual histograms",
        text,
        "Histograms of residuals in u and v, core and full range, under the expected curve.",
    )


def _binned(inputs: ReportInput) -> Caption:
    filled = sum(int((np.asarray(c.binned.count) > 0).sum()) for c in inputs.chips)
    significant = sum(int(significant_cells(c.binned).sum()) for c in inputs.chips)
    chance = CHANCE * filled
    axes, which, cannot = "", "", "the polynomial cannot follow"
    if inputs.fit.model.frames not in ("none", "shift"):  # they turn u and v
        axes = (
            ", along the axes of the polynomials, before the exposures' frames turn them: what"
            " belongs to the detector adds up however exposures are rolled"
        )
    if inputs.campaign is not None:
        which = (
            " These are the residuals of the joint fit, with all tables, in the cells of the test"
            " for structure (see the status)."
        )
        if inputs.campaign.tables:
            cannot = "neither tables nor polynomial follow"
            if significant < chance / 2:
                which += " They are fewer than by chance, as the tables follow these very stars."
    return Caption(
        "Binned residuals",
        f"Mean residual of each cell{axes}; dark arrows differ from zero by more than 2 σ."
        f" {significant} of {filled} cells do, and chance alone would give {chance:.0f}:"
        " neighbouring dark arrows that point the same way would be structure that"
        f" {cannot}.{which}",
        f"Map of binned residual vectors; {significant} of {filled} cells are significant.",
    )


def _outliers(inputs: ReportInput) -> Caption:
    text = "Joint posterior of the mixture's parameters; dashed lines hold 68 %."
    if inputs.posterior is not None and "f" in inputs.posterior.hyper:
        text += f" The fraction of false matches is {percent(inputs.sampled_mean('f'))}."
    return Caption(
        "Outlier fraction, jitter and outlier scale",
        text,
        "Corner plot of f, j and s_out, as sampled.",
    )


def _corner(inputs: ReportInput) -> Caption:
    assert inputs.posterior is not None
    sd = np.sqrt(np.diag(inputs.posterior.cov))
    formal = np.sqrt(np.diag(inputs.fit.cov))
    ratio = float(np.median(sd[formal > 0] / formal[formal > 0]))
    return Caption(
        "Coefficients with the strongest correlations",
        "Filled: posterior; lines: the formal Gaussian of least squares, whose estimate is the zero"
        " of each axis. Where they agree, the quoted errors and the rejection did no harm. Over all"
        f" parameters the posterior sd is {number(ratio)} times the formal σ (median).",
        "Corner plot of the most correlated coefficients, posterior against least squares.",
    )


def _traces(inputs: ReportInput) -> Caption:
    return Caption(
        "Chains",
        "The coefficients with the fewest effective draws, and the mixture's parameters. The"
        " ensembles are independent: equal levels and equal densities are what convergence looks"
        " like.",
        "Traces of the slowest parameters and densities by ensemble.",
    )


def _flow(inputs: ReportInput) -> Caption:
    v, where = _longest(inputs, "displacement")
    notes = {c.chip.name: c.displacement.part_note for c in inputs.chips}
    note = v.part_note
    if len(set(notes.values())) > 1:
        note = "; ".join(f"{name} {text}" for name, text in notes.items())
    return Caption(
        "Distortion, zeroth order suppressed",
        f"Vectors run from the array position to where the distortion puts it, {note}; the"
        f" largest is {_length(v.length_max, inputs)} at {where}, ringed."
        f"{_suppressed(inputs)}",
        f"Vector-flow diagram of the distortion, largest vector {_length(v.length_max, inputs)}.",
    )


def _non_linear(inputs: ReportInput) -> Caption:
    v, where = _longest(inputs, "non_linear")
    return Caption(
        "Distortion, non-linear part",
        f"Only {v.part_note}: what remains beyond shift, scale, rotation and skew, at most"
        f" {_length(v.length_max, inputs)} at {where}, ringed.",
        f"Vector diagram of the non-linear part, largest vector {_length(v.length_max, inputs)}.",
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


def _formal(inputs: ReportInput) -> Caption:
    by_kind = [
        max(maps, key=lambda m: m.radius_max)
        for maps in zip(*(c.maps for c in inputs.chips), strict=True)
    ]
    found = " and ".join(f"{_length(m.radius_max, inputs)} ({m.kind})" for m in by_kind)
    return Caption(
        "Formal-uncertainty diagram",
        "From each place four vectors to all combinations of ±1 σ in u and ±1 σ in v, enlarged as"
        f" stated above the panels; the largest radius is {found}.",
        f"Crosses of ±1 sigma over the detector; largest radius {found}.",
    )


def _radius(inputs: ReportInput) -> Caption:
    text = "Radial uncertainty hypot(σ u, σ v), its largest place ringed."
    pairs = [(c.formal_map, c.posterior_map) for c in inputs.chips]
    ratios = [p.radius / f.radius for f, p in pairs if p is not None]
    if ratios:
        low, high = (number(float(end(ratios))) for end in (np.min, np.max))
        text += (
            f" The posterior's is {low} to {high} times the formal one;"
            " above 1, least squares with rejection is too sure of itself."
        )
    return Caption("Uncertainty over the detector", text, f"Contour maps. {text}")


def _area(inputs: ReportInput) -> Caption:
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


def _terms(inputs: ReportInput) -> Caption:
    assert inputs.budget is not None
    *terms, total = inputs.budget.rows()
    top = max(terms, key=lambda r: r["radial"])
    return Caption(
        "Error budget by term",
        f"The largest term is {top['name']}, {_length(top['radial'], inputs)}, of a total of"
        f" {_length(total['radial'], inputs)} (radial rms over the detector).",
        f"Bars of the budget's terms; the largest is {top['name']}.",
    )


def _dominating(inputs: ReportInput) -> Caption:
    assert inputs.budget is not None
    b = inputs.budget
    share = b.share
    top = int(share.argmax())
    return Caption(
        "Dominating term",
        f"Where which term is largest: {b.names[top]} on {percent(share[top], 2)} of the grid."
        " A better calibration helps only where a term of the model leads.",
        f"Map of the dominating term, mostly {b.names[top]}.",
    )


def _margins(inputs: ReportInput) -> Caption:
    met = sum(m.verdict == "met" for m in inputs.margins)
    return Caption(
        "Margins",
        "Each statistic as a fraction of its limit: histogram of the draws, bar of their central"
        f" 95 %, marker at the median; left of the line is within the limit. {count(met)} of"
        f" {count(len(inputs.margins))} are met with the probability asked for.",
        f"Requirements against their limits; {met} of {len(inputs.margins)} are met.",
    )


_WRITERS = {
    "residuals_by_magnitude": _by_magnitude,
    "residual_histogram": _histogram,
    "residual_vectors": _binned,
    "outliers_corner": _outliers,
    "coefficients_corner": _corner,
    "traces": _traces,
    "distortion": _flow,
    "distortion_non_linear": _non_linear,
    "formal_uncertainty": _formal,
    "uncertainty_radius": _radius,
    "pixel_area": _area,
    "period_differences": period_caption,
    "budget_terms": _terms,
    "budget_dominating": _dominating,
    "margins": _margins,
    "horizon": horizon_caption,
    "holdout": holdout_caption,
}
