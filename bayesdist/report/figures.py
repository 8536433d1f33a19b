"""All figures of a report, by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from bayesdist.report.area import pixel_area
from bayesdist.report.budget import budget_terms, dominating_term
from bayesdist.report.campaign.figures import CampaignFigure, campaign_draws, campaign_figures
from bayesdist.report.context import ReportInput
from bayesdist.report.corners import corner_coefficients, corner_outliers
from bayesdist.report.holdout import holdout_figure
from bayesdist.report.horizon import probability_in_time
from bayesdist.report.margins import margins_against_limits
from bayesdist.report.mosaic import Mosaic
from bayesdist.report.periods import period_differences
from bayesdist.report.residuals import (
    MixtureCurve,
    residual_histogram,
    residuals_by_magnitude,
)
from bayesdist.report.selfcal import selfcal_figure
from bayesdist.report.traces import slowest_parameters, traces
from bayesdist.report.uncertainty import formal_uncertainty, uncertainty_radius
from bayesdist.report.vectors import residual_vectors, vector_flow

__all__ = ["all_figures", "plan_of_campaign", "plan_of_figures"]


def all_figures(inputs: ReportInput) -> dict[str, Figure]:
    """Every figure that the results allow, in the order of the report.

    Parameters
    ----------
    inputs : ReportInput

    Returns
    -------
    dict of str to matplotlib.figure.Figure
        Names serve as file names.  Without a posterior there are no corner plots and traces,
        without magnitudes no plot against them, without a budget or requirements none of these.
    """
    return {name: make() for name, make in plan_of_figures(inputs).items()}


def plan_of_figures(inputs: ReportInput) -> dict[str, Callable[[], Figure]]:
    """The same figures, not yet made."""
    out: dict[str, Callable[[], Figure]] = {}
    stars = inputs.stars
    drawn = {"unit": inputs.unit, "sampled": stars.partial, "things": inputs.words.things}
    if stars.table.mag is not None and np.isfinite(stars.table.mag).any():
        out["residuals_by_magnitude"] = partial(
            residuals_by_magnitude,
            stars.table.mag,
            stars.residual,
            errors=inputs.magnitude_errors,
            **drawn,
        )
    out["residual_histogram"] = lambda: residual_histogram(
        stars.residual, mixture_curves(inputs), **drawn
    )
    chips, mosaic = inputs.chips, mosaic_of(inputs)
    if inputs.campaign is not None:
        out |= campaign_draws(inputs.campaign, mosaic)
    out["residual_vectors"] = partial(
        residual_vectors, *(c.binned for c in chips), unit=inputs.unit, mosaic=mosaic
    )
    if inputs.held_out is not None:
        out["holdout"] = partial(holdout_figure, inputs.held_out, mosaic)
    posterior = inputs.posterior
    if posterior is not None:
        if posterior.hyper:
            out["outliers_corner"] = partial(corner_outliers, posterior)
        out["coefficients_corner"] = partial(corner_coefficients, posterior, inputs.fit)
        out["traces"] = lambda: traces(
            posterior, slowest_parameters(posterior, without=inputs.held)
        )
    maps = [m for c in chips for m in c.maps]
    flow = partial(vector_flow, mosaic=mosaic)
    out["distortion"] = partial(flow, *(c.displacement for c in chips))
    out["distortion_non_linear"] = partial(flow, *(c.non_linear for c in chips))
    out["formal_uncertainty"] = partial(formal_uncertainty, *maps, mosaic=mosaic)
    out["uncertainty_radius"] = partial(uncertainty_radius, *maps, mosaic=mosaic)
    out["pixel_area"] = partial(pixel_area, *(c.area for c in chips), mosaic=mosaic)
    if inputs.selfcal is not None:
        out["selfcal"] = partial(selfcal_figure, inputs.selfcal, inputs.unit)
    if inputs.periods is not None:
        out["period_differences"] = partial(period_differences, inputs.periods, mosaic)
    if inputs.budget is not None:
        out["budget_terms"] = partial(budget_terms, inputs.budget, mosaic.names)
        out["budget_dominating"] = partial(dominating_term, inputs.budget, mosaic)
    if inputs.margins:
        out["margins"] = partial(margins_against_limits, inputs.margins)
    if inputs.horizons:
        out["horizon"] = partial(probability_in_time, inputs.horizons)
    return out


def plan_of_campaign(inputs: ReportInput) -> dict[str, CampaignFigure]:
    """The figures that a campaign adds, not yet drawn; none for other runs."""
    if inputs.campaign is None:
        return {}
    return campaign_figures(inputs.campaign, mosaic_of(inputs))


def mosaic_of(inputs: ReportInput) -> Mosaic:
    """How the chips of a run are drawn."""
    chips = inputs.chips
    return Mosaic.of_chips([c.chip for c in chips], [c.place for c in chips])


def mixture_curves(inputs: ReportInput) -> tuple[MixtureCurve, MixtureCurve]:
    """What the results say of the distribution of the residuals in u and in v.

    Without quoted errors the rms of the fit stands in for them.
    """
    f, matches = inputs.fit, inputs.stars.table
    sigmas = [
        np.full(len(matches), rms) if sigma is None else np.asarray(sigma, float)
        for sigma, rms in ((matches.sigma_u, f.rms_u), (matches.sigma_v, f.rms_v))
    ]
    if inputs.posterior is None:
        return MixtureCurve(sigmas[0]), MixtureCurve(sigmas[1])
    mixture = inputs.posterior.mixture
    jitter = mixture.jitter if mixture.jitter is not None else inputs.sampled_mean("j")
    taken = 0.0 if inputs.stars.taken is None else inputs.stars.taken
    uniform = mixture.model == "uniform"
    scale = float(mixture.match_radius) if uniform else inputs.sampled_mean("s_out")
    u, v = (
        MixtureCurve(s, inputs.sampled_mean("f"), float(jitter), scale, mixture.model, taken)
        for s in sigmas
    )
    return u, v
