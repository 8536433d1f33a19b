"""Reduction of an error term that would meet a requirement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.requirements.requirement import Requirement

DRAWS = 1000  # number of draws, sufficient for a factor accurate to one or two percent
STEPS = 9  # number of bisections of the interval that contains the factor


@dataclass(frozen=True)
class RequiredReduction:
    """The error term that must be reduced to meet a requirement."""

    # the term that needs the smallest reduction if one term is sufficient; else the largest term
    term: str
    factor: float  # factor by which its error must be multiplied; 0 if it is not sufficient
    now: float  # its radial rms over the positions judged, in the unit of the requirement
    needed: float  # radial rms that it may have
    enough: bool  # True if the requirement is then met with the other terms unchanged
    unit: str

    @property
    def sentence(self) -> str:
        """The reduction in one sentence."""
        if not self.enough:
            return (
                f"no term can do it alone: the largest, {self.term} ({self.now:.3g} {self.unit} "
                "radial rms), could vanish and the requirement would still not be met"
            )
        return (
            f"it would be met if {self.term} fell from {self.now:.3g} to {self.needed:.3g} "
            f"{self.unit} radial rms, all else being as it is"
        )


def required_reduction(
    errors: DrawnErrors, requirement: Requirement, domain: EvaluationDomain, factor: float
) -> RequiredReduction | None:
    """Find the term that needs the smallest reduction for a requirement to be met.

    Each term in turn is multiplied by a number between 0 and 1, with the same draws throughout.

    `domain`: positions at the worst epoch. `factor`: size of the solution's unit in the unit of the
    requirement. Returns None if the requirement is met with the draws used here.
    """
    n = min(DRAWS, errors.n_draws)
    statistic = requirement.statistic

    def met(term: str, size: float) -> bool:
        statistics = errors.statistics(domain, [statistic], scale={term: size}, n_draws=n)
        return bool(
            np.mean(factor * statistics[statistic] <= requirement.limit) >= requirement.probability
        )

    if met("", 1.0):  # met with these draws, so that no reduction can be stated
        return None
    sizes = {name: factor * size for name, size in errors.sizes(domain).items()}
    largest = max(sizes, key=lambda name: sizes[name])
    best, best_factor = "", 0.0
    for name in sizes:
        # terms that need a larger reduction than the best one so far are skipped
        if sizes[name] > 0 and met(name, best_factor):
            low, high = 0.0, 1.0
            for _ in range(STEPS):
                middle = (low + high) / 2
                low, high = (middle, high) if met(name, middle) else (low, middle)
            if not best or low > best_factor:
                best, best_factor = name, low
    if not best:
        return RequiredReduction(largest, 0.0, sizes[largest], 0.0, False, requirement.unit)
    now = sizes[best]
    return RequiredReduction(best, best_factor, now, best_factor * now, True, requirement.unit)
