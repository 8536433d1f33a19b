"""The sentence under each figure that says what to see, and the words in place of the picture."""

from __future__ import annotations

from bayesdist.assess.product_terms import PRODUCT
from bayesdist.report.caption import Caption
from bayesdist.report.context import ReportInput
from bayesdist.report.fit_captions import (
    binned_caption,
    by_magnitude_caption,
    corner_caption,
    histogram_caption,
    outliers_caption,
    traces_caption,
)
from bayesdist.report.holdout import holdout_caption
from bayesdist.report.horizon import horizon_caption
from bayesdist.report.map_captions import (
    area_caption,
    flow_caption,
    formal_caption,
    non_linear_caption,
    radius_caption,
)
from bayesdist.report.numbers import count, percent
from bayesdist.report.periods import period_caption
from bayesdist.report.selfcal import selfcal_caption

__all__ = ["SECTIONS", "Caption", "caption"]

SECTIONS: dict[str, tuple[str, ...]] = {
    "holdout": ("holdout",),
    "data": ("residuals_by_magnitude",),
    "selfcal": ("selfcal",),
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


def _terms(inputs: ReportInput) -> Caption:
    assert inputs.budget is not None
    *terms, total = (r for r in inputs.budget.rows() if r["kind"] != PRODUCT)
    top = max(terms, key=lambda r: r["radial"])
    return Caption(
        "Error budget by term",
        f"The largest term is {top['name']}, {inputs.length(top['radial'])}, of a total of"
        f" {inputs.length(total['radial'])} (radial rms over the detector).",
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
    "residuals_by_magnitude": by_magnitude_caption,
    "residual_histogram": histogram_caption,
    "residual_vectors": binned_caption,
    "outliers_corner": outliers_caption,
    "coefficients_corner": corner_caption,
    "traces": traces_caption,
    "distortion": flow_caption,
    "distortion_non_linear": non_linear_caption,
    "formal_uncertainty": formal_caption,
    "uncertainty_radius": radius_caption,
    "pixel_area": area_caption,
    "period_differences": period_caption,
    "budget_terms": _terms,
    "budget_dominating": _dominating,
    "margins": _margins,
    "horizon": horizon_caption,
    "holdout": holdout_caption,
    "selfcal": selfcal_caption,
}
