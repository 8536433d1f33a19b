"""All figures of a report, by name, and their files."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from bayesdist.data.files import atomic_path
from bayesdist.errors import InputError
from bayesdist.report.area import pixel_area
from bayesdist.report.budget import budget_terms, dominating_term
from bayesdist.report.context import ReportInput
from bayesdist.report.corners import corner_coefficients, corner_outliers
from bayesdist.report.margins import margins_against_limits
from bayesdist.report.residuals import (
    MixtureCurve,
    posterior_residuals,
    residual_histogram,
    residuals_by_magnitude,
)
from bayesdist.report.style import figure_style
from bayesdist.report.traces import traces
from bayesdist.report.uncertainty import formal_uncertainty, uncertainty_radius
from bayesdist.report.vectors import residual_vectors, vector_flow

__all__ = ["DPI", "all_figures", "png_bytes", "save_figures"]

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
    residual = posterior_residuals(inputs.matches, inputs.solution)
    if inputs.matches.mag is not None and np.isfinite(inputs.matches.mag).any():
        out["residuals_by_magnitude"] = residuals_by_magnitude(
            inputs.matches.mag, residual, unit=inputs.unit, errors=inputs.magnitude_errors
        )
    out["residual_histogram"] = residual_histogram(
        residual, mixture_curves(inputs), unit=inputs.unit
    )
    out["residual_vectors"] = residual_vectors(
        inputs.binned, unit=inputs.unit, size=inputs.chip.size
    )
    if inputs.posterior is not None:
        if inputs.posterior.hyper:
            out["outliers_corner"] = corner_outliers(inputs.posterior)
        out["coefficients_corner"] = corner_coefficients(inputs.posterior, inputs.fit)
        out["traces"] = traces(inputs.posterior)
    out["distortion"] = vector_flow(inputs.displacement)
    out["distortion_non_linear"] = vector_flow(inputs.non_linear)
    out["formal_uncertainty"] = formal_uncertainty(*inputs.maps)
    out["uncertainty_radius"] = uncertainty_radius(*inputs.maps)
    out["pixel_area"] = pixel_area(inputs.area)
    if inputs.budget is not None:
        out["budget_terms"] = budget_terms(inputs.budget)
        out["budget_dominating"] = dominating_term(inputs.budget)
    if inputs.margins:
        out["margins"] = margins_against_limits(inputs.margins)
    return out


def mixture_curves(inputs: ReportInput) -> tuple[MixtureCurve, MixtureCurve]:
    """What the results say of the distribution of the residuals in u and in v.

    Without quoted errors the rms of the fit stands in for them.
    """
    f, matches = inputs.fit, inputs.matches
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


def png_bytes(figure: Figure) -> bytes:
    """A figure as the bytes of a PNG file, cut to what is drawn."""
    buffer = io.BytesIO()
    with figure_style():  # mathematical text and ticks read the settings only when drawn
        figure.savefig(buffer, format="png", dpi=DPI, bbox_inches="tight", pad_inches=0.05)
    return buffer.getvalue()


def save_figures(figures: Mapping[str, Figure], folder: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Write figures as PNG files.

    Parameters
    ----------
    figures : mapping of str to matplotlib.figure.Figure
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
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"the folder cannot be made ({error.strerror or error})",
            where=str(folder),
            do="choose one that you may write to",
        ) from error
    paths = []
    for name, figure in figures.items():
        path = folder / f"{name}.png"
        with atomic_path(path) as temporary:
            temporary.write_bytes(png_bytes(figure))
        paths.append(path)
    return tuple(paths)
