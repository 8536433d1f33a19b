"""The posterior as a result, and what it says of each star."""

from bayesdist.infer.posterior.posterior import Certificate, Posterior, SamplerInfo

__all__ = ["Certificate", "Posterior", "SamplerInfo"]
