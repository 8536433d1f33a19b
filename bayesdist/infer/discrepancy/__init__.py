"""Discrepancy: structure outside the fitted model, with priors and posteriors of its own."""

from bayesdist.infer.discrepancy.priors import DiscrepancyPriors
from bayesdist.infer.discrepancy.result import Discrepancy
from bayesdist.infer.discrepancy.solve import estimate_discrepancy

__all__ = ["Discrepancy", "DiscrepancyPriors", "estimate_discrepancy"]
