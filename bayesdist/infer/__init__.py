"""From matches to knowledge: the linear fit, the outlier mixture, and its posterior."""

from __future__ import annotations

from typing import Any

from bayesdist.lazy import lazy_name

_HOMES = {
    "bayesdist.infer.catalogue.by_magnitude": ("fit_by_magnitude",),
    "bayesdist.infer.catalogue.catalogue_shear": (
        "CatalogueShear",
        "catalogue_shear",
    ),
    "bayesdist.infer.catalogue.star_errors": (
        "StarCovariance",
        "star_covariance",
        "with_star_errors",
    ),
    "bayesdist.infer.density.memberships": (
        "Memberships",
        "memberships",
        "outlier_probability",
    ),
    "bayesdist.infer.equations.priors": ("GaussianPriors",),
    "bayesdist.infer.exposures.alone": (
        "ExposureSolutions",
        "fit_exposures",
    ),
    "bayesdist.infer.exposures.hierarchy": (
        "HierarchicalFit",
        "fit_hierarchical",
        "held_in_reference",
    ),
    "bayesdist.infer.files.fit_file": (
        "load_fit",
        "save_fit",
    ),
    "bayesdist.infer.files.posterior_file": (
        "load_posterior",
        "save_posterior",
    ),
    "bayesdist.infer.linear": (
        "LinearFit",
        "build_model",
        "fit_linear",
        "residuals",
    ),
    "bayesdist.infer.nodes": (
        "TableFit",
        "TablePosterior",
        "binned_table",
        "field_table",
        "fit_with_tables",
    ),
    "bayesdist.infer.posterior": (
        "Posterior",
        "SamplerInfo",
    ),
    "bayesdist.infer.sampler.convergence": (
        "Convergence",
        "Limits",
    ),
    "bayesdist.infer.sampler.sample": ("sample",),
    "bayesdist.infer.stars.mixture": ("OutlierMixture",),
    "bayesdist.infer.stars.shards": (
        "Compute",
        "Matches",
        "Shards",
        "load",
    ),
    "bayesdist.infer.transforms": (
        "LinearTerms",
        "ReferenceGauge",
        "View",
        "in_exposure",
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
