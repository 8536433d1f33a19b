"""From matches to knowledge: the linear fit, the outlier mixture, and its posterior."""

from bayesdist.infer.labelled.convergence import Convergence, Limits
from bayesdist.infer.labelled.fit_file import load_fit, save_fit
from bayesdist.infer.labelled.posterior_file import load_posterior, save_posterior
from bayesdist.infer.linear import LinearFit, build_model, fit_by_magnitude, fit_linear
from bayesdist.infer.mixture import OutlierMixture
from bayesdist.infer.posterior import Posterior, SamplerInfo
from bayesdist.infer.prior import GaussianPriors
from bayesdist.infer.sampling import sample

__all__ = [
    "Convergence",
    "GaussianPriors",
    "Limits",
    "LinearFit",
    "OutlierMixture",
    "Posterior",
    "SamplerInfo",
    "build_model",
    "fit_by_magnitude",
    "fit_linear",
    "load_fit",
    "load_posterior",
    "sample",
    "save_fit",
    "save_posterior",
]
