"""Posterior draws with their diagnostics and files, and the outlier probability of each star."""

from bayesdist.infer.posterior.posterior import Certificate, Posterior, SamplerInfo

__all__ = ["Certificate", "Posterior", "SamplerInfo"]
