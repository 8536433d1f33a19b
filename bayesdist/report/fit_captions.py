"""Words of the figures that show data, fit and sampling."""

from __future__ import annotations

import numpy as np

from bayesdist.report.caption import Caption
from bayesdist.report.context import ReportInput
from bayesdist.report.numbers import number, percent
from bayesdist.report.vectors import CHANCE, significant_cells

__all__ = [
    "binned_caption",
    "by_magnitude_caption",
    "corner_caption",
    "histogram_caption",
    "outliers_caption",
    "traces_caption",
]


def _sampled(inputs: ReportInput) -> str:
    return f" Drawn from {inputs.sample}." if inputs.sample else ""


def by_magnitude_caption(inputs: ReportInput) -> Caption:
    words = inputs.words
    text = f"Residuals grow towards faint stars; colour counts {words.things}."
    if inputs.magnitude_errors is not None:
        text += " The lines are ±1 σ as assigned to each magnitude: about two thirds of the"
        text += f" {words.things} lie between them"
        text += ", or somewhat more, because the stars were fitted to them." if words.taken else "."
    text += _sampled(inputs)
    return Caption(
        "Residuals against magnitude",
        text,
        "Two density plots of the residuals in u and v against magnitude, widening to faint stars.",
    )


def histogram_caption(inputs: ReportInput) -> Caption:
    words = inputs.words
    if inputs.posterior is None:
        text = (
            "The line is what the quoted errors alone predict;"
            f" {words.things} above it in the wings are outliers."
        )
    else:
        text = (
            f"The line is the fitted mixture summed over the {words.things}' own errors"
            f"{words.taken}, not a fit to the bars: it should follow them in the core (top) and in"
            " the wings (bottom, logarithmic)."
        )
        if inputs.posterior.mixture.model != "none":
            text += f" The dashed part is {words.false}."
    text += _sampled(inputs)
    return Caption(
        "Residual histograms",
        text,
        "Histograms of residuals in u and v, core and full range, under the expected curve.",
    )


def binned_caption(inputs: ReportInput) -> Caption:
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
    if inputs.words.taken:
        which = (
            " Stars were fitted to these very detections, so that fewer may do so than by chance:"
            " the status has the test that allows for it."
        )
    return Caption(
        "Binned residuals",
        f"Mean residual of each cell{axes}; dark arrows differ from zero by more than 2 σ."
        f" {significant} of {filled} cells do, and chance alone would give {chance:.0f}:"
        " neighbouring dark arrows that point the same way would be structure that"
        f" {cannot}.{which}",
        f"Map of binned residual vectors; {significant} of {filled} cells are significant.",
    )


def outliers_caption(inputs: ReportInput) -> Caption:
    text = "Joint posterior of the mixture's parameters; dashed lines hold 68 %."
    if inputs.posterior is not None and "f" in inputs.posterior.hyper:
        text += f" The fraction of {inputs.words.false} is {percent(inputs.sampled_mean('f'))}."
    return Caption(
        "Outlier fraction, jitter and outlier scale",
        text,
        "Corner plot of f, j and s_out, as sampled.",
    )


def corner_caption(inputs: ReportInput) -> Caption:
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


def traces_caption(inputs: ReportInput) -> Caption:
    return Caption(
        "Chains",
        "The coefficients with the fewest effective draws, and the mixture's parameters. The"
        " ensembles are independent: equal levels and equal densities are what convergence looks"
        " like.",
        "Traces of the slowest parameters and densities by ensemble.",
    )
