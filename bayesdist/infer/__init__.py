"""From matches to knowledge: the linear fit, the outlier mixture, and its posterior."""

from bayesdist.infer.labelled.convergence import Convergence, Limits
from bayesdist.infer.labelled.fit_file import load_fit, save_fit
from bayesdist.infer.labelled.posterior_file import load_posterior, save_posterior
from bayesdist.infer.linear import (
    LinearFit,
    build_model,
    fit_by_magnitude,
    fit_linear,
    residuals,
)
from bayesdist.infer.membership import Memberships, memberships, outlier_probability
from bayesdist.infer.mixture import OutlierMixture
from bayesdist.infer.posterior import Posterior, SamplerInfo
from bayesdist.infer.prior import GaussianPriors
from bayesdist.infer.sampling import sample
from bayesdist.infer.shards import Compute, Matches, Shards, load

__all__ = [
    "Compute",
    "Convergence",
    "GaussianPriors",
    "Limits",
    "LinearFit",
    "Matches",
    "Memberships",
    "OutlierMixture",
    "Posterior",
    "SamplerInfo",
    "Shards",
    "build_model",
    "fit_by_magnitude",
    "fit_linear",
    "load",
    "load_fit",
    "load_posterior",
    "memberships",
    "outlier_probability",
    "residuals",
    "sample",
    "save_fit",
    "save_posterior",
]
