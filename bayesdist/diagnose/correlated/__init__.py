"""Discrepancy: structure that the fitted model lacks, with separate priors and posteriors."""

from bayesdist.diagnose.correlated.estimate import estimate_discrepancy
from bayesdist.diagnose.correlated.priors import DiscrepancyPriors
from bayesdist.diagnose.correlated.result import Discrepancy

__all__ = ["Discrepancy", "DiscrepancyPriors", "estimate_discrepancy"]
