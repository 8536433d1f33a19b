"""Reduction of an error term that would meet a requirement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.requirements.requirement import Requirement

DRAWS = 1000  # a factor is wanted to a percent or two
STEPS = 9  # halvings of the interval in which the factor lies


@dataclass(frozen=True)
class RequiredReduction:
    """Error term that must be reduced."""

    # where one term can do it alone, that which has to shrink least; else the largest one
    term: str
    factor: float  # by which its error must be multiplied; 0 where it cannot do it alone
    now: float  # its radial rms over the positions judged, in the requirement's unit
    needed: float
    enough: bool  # True if the requirement is met then, the other terms being as they are
    unit: str

    @property
    def sentence(self) -> str:
        """The reduction in words."""
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
    """The term that has to shrink least for a requirement to be met; None if it is nearly met.

    Each term by itself is multiplied by a number between 0 and 1, with the same draws throughout.

    `domain`: where, and at the worst epoch. `factor`: unit of the solution, in the unit of the
    requirement.
    """
    n = min(DRAWS, errors.n_draws)
    statistic = requirement.statistic

    def met(term: str, size: float) -> bool:
        found = errors.statistics(domain, [statistic], scale={term: size}, n_draws=n)
        return bool(
            np.mean(factor * found[statistic] <= requirement.limit) >= requirement.probability
        )

    if met("", 1.0):  # on these draws: no term has to shrink by a size that could be stated
        return None
    sizes = {name: factor * size for name, size in errors.sizes(domain).items()}
    largest = max(sizes, key=lambda name: sizes[name])
    best, most = "", 0.0
    for name in sizes:
        # a term that must shrink more than another one is not bisected
        if sizes[name] > 0 and met(name, most):
            low, high = 0.0, 1.0
            for _ in range(STEPS):
                middle = (low + high) / 2
                low, high = (middle, high) if met(name, middle) else (low, middle)
            if not best or low > most:
                best, most = name, low
    if not best:
        return RequiredReduction(largest, 0.0, sizes[largest], 0.0, False, requirement.unit)
    now = sizes[best]
    return RequiredReduction(best, most, now, most * now, True, requirement.unit)
