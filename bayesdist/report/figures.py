"""All figures of a report, by name, and their files."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from bayesdist.data.files import atomic_path, made_folder
from bayesdist.report.area import pixel_area
from bayesdist.report.budget import budget_terms, dominating_term
from bayesdist.report.campaign.figures import CampaignFigure, campaign_figures
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
from bayesdist.report.style import figure_style
from bayesdist.report.traces import slowest_parameters, traces
from bayesdist.report.uncertainty import formal_uncertainty, uncertainty_radius
from bayesdist.report.vectors import residual_vectors, vector_flow

__all__ = ["DPI", "all_figures", "drawn", "plan_of_campaign", "save_images", "save_pdfs"]

DPI = 150


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
    out: dict[str, Figure] = {}
    stars = inputs.stars
    drawn = {"unit": inputs.unit, "sampled": stars.partial}
    if stars.table.mag is not None and np.isfinite(stars.table.mag).any():
        out["residuals_by_magnitude"] = residuals_by_magnitude(
            stars.table.mag, stars.residual, errors=inputs.magnitude_errors, **drawn
        )
    out["residual_histogram"] = residual_histogram(stars.residual, mixture_curves(inputs), **drawn)
    chips, mosaic = inputs.chips, mosaic_of(inputs)
    out |= {name: one.draw() for name, one in plan_of_campaign(inputs).items()}
    out["residual_vectors"] = residual_vectors(
        *(c.binned for c in chips), unit=inputs.unit, mosaic=mosaic
    )
    if inputs.held_out is not None:
        out["holdout"] = holdout_figure(inputs.held_out, mosaic)
    if inputs.posterior is not None:
        if inputs.posterior.hyper:
            out["outliers_corner"] = corner_outliers(inputs.posterior)
        out["coefficients_corner"] = corner_coefficients(inputs.posterior, inputs.fit)
        slowest = slowest_parameters(inputs.posterior, without=inputs.held)
        out["traces"] = traces(inputs.posterior, slowest)
    maps = [m for c in chips for m in c.maps]
    out["distortion"] = vector_flow(*(c.displacement for c in chips), mosaic=mosaic)
    out["distortion_non_linear"] = vector_flow(*(c.non_linear for c in chips), mosaic=mosaic)
    out["formal_uncertainty"] = formal_uncertainty(*maps, mosaic=mosaic)
    out["uncertainty_radius"] = uncertainty_radius(*maps, mosaic=mosaic)
    out["pixel_area"] = pixel_area(*(c.area for c in chips), mosaic=mosaic)
    if inputs.periods is not None:
        out["period_differences"] = period_differences(inputs.periods, mosaic)
    if inputs.budget is not None:
        out["budget_terms"] = budget_terms(inputs.budget, mosaic.names)
        out["budget_dominating"] = dominating_term(inputs.budget, mosaic)
    if inputs.margins:
        out["margins"] = margins_against_limits(inputs.margins)
    if inputs.horizons:
        out["horizon"] = probability_in_time(inputs.horizons)
    return out


def plan_of_campaign(inputs: ReportInput) -> dict[str, CampaignFigure]:
    """The figures that a campaign adds, not yet drawn; none for other runs."""
    if inputs.campaign is None:
        return {}
    return campaign_figures(inputs.campaign, mosaic_of(inputs))


def mosaic_of(inputs: ReportInput) -> Mosaic:
    """How the chips of a run are drawn."""
    chips = inputs.chips
    return Mosaic(
        sizes=tuple(c.chip.size for c in chips),
        names=tuple(c.chip.name if inputs.several else "" for c in chips),
        places=tuple(c.place for c in chips),
    )


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
    uniform = mixture.model == "uniform"
    scale = float(mixture.match_radius) if uniform else inputs.sampled_mean("s_out")
    u, v = (
        MixtureCurve(s, inputs.sampled_mean("f"), float(jitter), scale, mixture.model)
        for s in sigmas
    )
    return u, v


def drawn(figures: Mapping[str, Figure]) -> dict[str, bytes]:
    """Figures as PNG files, by name: drawn once, for the folder and for the report.

    Their layout is settled by that, and serves other files of them: it takes as long as drawing.
    """
    out = {}
    for name, figure in figures.items():
        out[name] = _with_palette(_file_bytes(figure, "png"))
        figure.set_layout_engine("none")
    return out


def _with_palette(png: bytes) -> bytes:
    """A PNG file with 256 colours: a third of the size, and no eye sees the difference."""
    with Image.open(io.BytesIO(png)) as image:
        few = image.convert("RGB").quantize(
            256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE
        )
    buffer = io.BytesIO()
    few.save(buffer, format="png", dpi=(DPI, DPI))
    return buffer.getvalue()


def _file_bytes(figure: Figure, kind: str, **options: Any) -> bytes:
    """A figure as the bytes of a file, cut to what is drawn."""
    buffer = io.BytesIO()
    with figure_style():  # mathematical text and ticks read the settings only when drawn
        figure.savefig(
            buffer, format=kind, dpi=DPI, bbox_inches="tight", pad_inches=0.05, **options
        )
    return buffer.getvalue()


def save_images(images: Mapping[str, bytes], folder: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Write the PNG files of a report.

    Parameters
    ----------
    images : mapping of str to bytes
        As of `drawn`.
    folder : path-like
        Made where it does not exist.

    Returns
    -------
    tuple of pathlib.Path

    Raises
    ------
    InputError
        When the folder cannot be made or a file cannot be written.
    """
    folder = made_folder(folder)
    paths = []
    for name, png in images.items():
        path = folder / f"{name}.png"
        with atomic_path(path) as temporary:
            temporary.write_bytes(png)
        paths.append(path)
    return tuple(paths)


def save_pdfs(figures: Mapping[str, Figure], folder: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Write figures as PDF files whose letters are letters.

    Parameters
    ----------
    figures : mapping of str to matplotlib.figure.Figure
    folder : path-like
        One that is there.

    Returns
    -------
    tuple of pathlib.Path

    Raises
    ------
    InputError
        When a file cannot be written.
    """
    paths = []
    for name, figure in figures.items():
        path = Path(folder) / f"{name}.pdf"
        with atomic_path(path) as temporary:
            temporary.write_bytes(_file_bytes(figure, "pdf", metadata={"CreationDate": None}))
        paths.append(path)
    return tuple(paths)
