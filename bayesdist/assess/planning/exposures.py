"""Number and dates of further exposures that would meet a requirement."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

from bayesdist.infer.compare.planning import with_information
from bayesdist.infer.solution.solution import Solution
from bayesdist.utils.arrays import Float

MOST = 4096  # exposures beyond which more are no plan


@dataclass(frozen=True, eq=False)
class Schedule:
    """Dates at which exposures would be taken."""

    name: str
    # (d, d), of one exposure about polynomials and drift, on average over the dates of the schedule
    information: Float


@dataclass(frozen=True)
class Need:
    """Number of exposures that a schedule takes."""

    schedule: str
    exposures: int | None  # fewest that meet the requirement; None where even very many would not
    probability: float  # of meeting the limit, with so many; with very many where none suffice

    @property
    def sentence(self) -> str:
        """The need in words."""
        if self.exposures is None:
            return (
                f"{self.schedule}: {MOST} exposures would still miss the limit (probability "
                f"{self.probability:.3g}): what more data do not make smaller is too large"
            )
        if not self.exposures:
            return f"{self.schedule}: met as it is (probability {self.probability:.3g})"
        return (
            f"{self.schedule}: {self.exposures} more "
            f"{'exposure' if self.exposures == 1 else 'exposures'} (probability then "
            f"{self.probability:.3g})"
        )


def exposures_needed(
    solution: Solution,
    schedules: Sequence[Schedule],
    probability_met: Callable[[Solution], float],
    asked: float,
) -> tuple[Need, ...]:
    """The fewest exposures of each schedule with which a requirement is met.

    `solution`: as it is now. `probability_met`: probability of meeting the requirement with a
    solution; with the same random numbers each time, so that it rises with the number of exposures.
    """
    now = probability_met(solution)
    if now >= asked:
        return tuple(Need(one.name, 0, now) for one in schedules)
    return tuple(_need(solution, one, probability_met, asked) for one in schedules)


def _need(
    solution: Solution,
    schedule: Schedule,
    probability_met: Callable[[Solution], float],
    asked: float,
) -> Need:
    @cache
    def reached(n: int) -> float:
        return probability_met(with_information(solution, n * schedule.information))

    if reached(MOST) < asked:
        return Need(schedule.name, None, reached(MOST))
    enough = 1
    while reached(enough) < asked:  # doubling: most needs are small
        enough *= 2
    numbers = range(enough // 2 + 1, enough + 1)
    n = numbers[bisect_left(numbers, asked, key=reached)]
    return Need(schedule.name, n, reached(n))
