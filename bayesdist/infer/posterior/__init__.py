"""Posterior draws with their diagnostics and files, and the outlier probability of each star."""

from bayesdist.infer.posterior.posterior import Posterior, SamplerInfo

__all__ = ["Posterior", "SamplerInfo"]
