"""From matches to knowledge: the linear fit, the outlier mixture, and its posterior."""

from bayesdist.infer.catalogue.by_magnitude import fit_by_magnitude
from bayesdist.infer.catalogue.star_errors import StarCovariance, star_covariance
from bayesdist.infer.density.memberships import Memberships, memberships
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.exposures.alone import ExposureSolutions, fit_exposures
from bayesdist.infer.exposures.hierarchy import HierarchicalFit, fit_hierarchical, held_in_reference
from bayesdist.infer.files import load_fit, load_posterior, save_fit, save_posterior
from bayesdist.infer.linear import LinearFit, Rejection, build_model, fit_linear, residuals
from bayesdist.infer.nodes import (
    TableFit,
    TablePosterior,
    binned_table,
    field_table,
    fit_with_tables,
)
from bayesdist.infer.posterior import Posterior, SamplerInfo
from bayesdist.infer.sampler.convergence import Convergence, Limits
from bayesdist.infer.sampler.sample import sample
from bayesdist.infer.stars.mixture import OutlierMixture
from bayesdist.infer.stars.shards import Compute, Matches, Shards, load
from bayesdist.infer.transforms import (
    LinearTerms,
    ReferenceGauge,
    View,
    linear_terms,
    lines,
    reference_gauge,
    segment,
    without_frames,
)

__all__ = [
    "Compute",
    "Convergence",
    "ExposureSolutions",
    "GaussianPriors",
    "HierarchicalFit",
    "Limits",
    "LinearFit",
    "LinearTerms",
    "Matches",
    "Memberships",
    "OutlierMixture",
    "Posterior",
    "ReferenceGauge",
    "Rejection",
    "SamplerInfo",
    "Shards",
    "StarCovariance",
    "TableFit",
    "TablePosterior",
    "View",
    "binned_table",
    "build_model",
    "field_table",
    "fit_by_magnitude",
    "fit_exposures",
    "fit_hierarchical",
    "fit_linear",
    "fit_with_tables",
    "held_in_reference",
    "linear_terms",
    "lines",
    "load",
    "load_fit",
    "load_posterior",
    "memberships",
    "reference_gauge",
    "residuals",
    "sample",
    "save_fit",
    "save_posterior",
    "segment",
    "star_covariance",
    "without_frames",
]
