"""Fits and posteriors of a distortion model: least squares, outlier mixture, sampling."""

from __future__ import annotations

from typing import Any

from bayesdist.lazy import lazy_name

_HOMES = {
    "bayesdist.infer.catalogue.by_magnitude": ("fit_by_magnitude",),
    "bayesdist.infer.catalogue.star_errors": ("StarCovariance", "StarErrors", "star_covariance"),
    "bayesdist.infer.posterior.memberships": ("Memberships", "memberships"),
    "bayesdist.infer.equations.priors": ("GaussianPriors",),
    "bayesdist.infer.exposures.alone": ("ExposureSolutions", "fit_exposures"),
    "bayesdist.infer.exposures.hierarchy": (
        "HierarchicalFit",
        "fit_hierarchical",
        "held_in_reference",
    ),
    "bayesdist.infer.files": ("load_fit", "load_posterior", "save_fit", "save_posterior"),
    "bayesdist.infer.linear": ("LinearFit", "Rejection", "build_model", "fit_linear", "residuals"),
    "bayesdist.infer.nodes": (
        "TableFit",
        "TablePosterior",
        "binned_table",
        "field_table",
        "fit_with_tables",
    ),
    "bayesdist.infer.posterior": ("Posterior", "SamplerInfo"),
    "bayesdist.infer.convergence": ("Convergence", "Limits"),
    "bayesdist.infer.sampler.sample": ("sample",),
    "bayesdist.infer.solution": ("ReferenceGauge", "Solution", "TransformedSolution"),
    "bayesdist.infer.stars.mixture": ("OutlierMixture",),
    "bayesdist.infer.stars.loading": ("load",),
    "bayesdist.infer.stars.shards": ("Compute", "Shards"),
    "bayesdist.infer.transforms": (
        "LinearTerms",
        "linear_terms",
        "lines",
        "reference_gauge",
        "segment",
        "without_frames",
    ),
}

__all__ = sorted(name for names in _HOMES.values() for name in names)


def __getattr__(name: str) -> Any:
    return lazy_name(__name__, _HOMES, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
