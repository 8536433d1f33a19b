"""Number and dates of further exposures that would meet a requirement."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from bayesdist.utils.arrays import Float

MOST = 4096  # largest number of exposures that is considered
# The range of the answer contains the numbers with a probability that differs by at most this. With
# simulated exposures the limits were met less often than predicted, by 0.27 +- 0.07
# (docs/validation.md).
PROBABILITY_ERROR = 0.25
SMALL = 0.05  # probability of meeting a limit, below which errors are called too large for it


class Further(Protocol):
    """Further exposures whose effects are not proportional to their number."""

    def information(self, n: int) -> Float:
        """Information (d, d) of n exposures on polynomials and drift, or (D, D) on all."""
        ...

    def deviations(self, n: int) -> float:
        """Effect of deviations of all exposures on the polynomials, relative to the present one."""
        ...


@dataclass(frozen=True, eq=False)
class Schedule:
    """Dates of planned exposures."""

    name: str
    # (d, d), information of one exposure on polynomials and drift, averaged over the dates
    information: Float
    single_date: bool = False  # True if all further exposures have the same date
    # equally probable exposures, if their information is not proportional to their number
    together: Sequence[Further] = ()

    def of(self, n: int) -> list[Float]:
        """Information (d, d) of n exposures: equally probable values."""
        return [further.information(n) for further in self.together] or [n * self.information]

    def deviations(self, n: int, n_existing: int) -> list[float]:
        """Effect of the exposures' deviations on their mean, relative to the present one.

        A list with one value for each information in `of`.
        """
        independent = float(np.sqrt(n_existing / (n_existing + n)))
        return [further.deviations(n) for further in self.together] or [independent]


@dataclass(frozen=True)
class Need:
    """Number of exposures needed with a schedule.

    Parameters
    ----------
    schedule : str
        Name of the schedule.
    exposures : int or None
        Smallest number with which the requirement is met with the required probability; None if
        `MOST` are not enough.
    probability : float
        Probability that the requirement is met with this number, or with `MOST` if these are not
        enough.
    interval : tuple of (int or None)
        Smallest numbers for a probability that is lower and higher by `PROBABILITY_ERROR`; the
        higher one is at most halfway to 1. None if `MOST` are not enough.
    by_number : mapping of int to float
        Probability that the requirement is met, by number of exposures, ascending.
    """

    schedule: str
    exposures: int | None
    probability: float
    interval: tuple[int | None, int | None] = (0, 0)
    by_number: Mapping[int, float] = field(default_factory=dict)

    @property
    def sentence(self) -> str:
        """The need in one sentence."""
        if self.exposures == 0:
            return f"{self.schedule}: met as it is (probability {self.probability:.3g})"
        if self.exposures is None:
            large = "is" if self.probability < SMALL else "may be"
            return (
                f"{self.schedule}: with {MOST} more exposures the probability of meeting the limit "
                f"is {self.probability:.3g}: what more data do not make smaller {large} too large"
            )
        low, high = self.interval
        upper = f"more than {MOST}" if high is None else str(high)
        return (
            f"{self.schedule}: {self.exposures} more "
            f"{'exposure' if self.exposures == 1 else 'exposures'}, range {low} to {upper} "
            f"(probability then {self.probability:.3g})"
        )

    @property
    def table(self) -> str:
        """Probabilities of the numbers that were evaluated, as text; empty if already met."""
        return ", ".join(f"{n}: {p:.2f}" for n, p in self.by_number.items())


def exposures_needed(
    schedules: Sequence[Schedule],
    probability_of: Callable[[Schedule], Callable[[int], float]],
    asked: float,
    *,
    now: float,
) -> tuple[Need, ...]:
    """Smallest number of exposures of each schedule with which a requirement is met.

    Parameters
    ----------
    schedules : sequence of Schedule
    probability_of : callable
        Function of a schedule that returns a function of the number of exposures, which returns the
        probability that the requirement is met. It must use the same random numbers in each call,
        so that the probability increases with the number of exposures.
    asked : float
        Required probability.
    now : float
        Probability that the limit is met without further exposures.

    Returns
    -------
    tuple of Need
    """
    if now >= asked:
        return tuple(Need(schedule.name, 0, now) for schedule in schedules)
    return tuple(_need(schedule.name, probability_of(schedule), asked) for schedule in schedules)


def _need(name: str, probability_met: Callable[[int], float], asked: float) -> Need:
    probabilities = dict[int, float]()

    def reached(n: int) -> float:
        if n not in probabilities:
            probabilities[n] = probability_met(n)
        return probabilities[n]

    def fewest(probability: float) -> int | None:
        enough = 1
        while reached(enough) < probability:  # doubling, because most needs are small
            if enough == MOST:
                return None
            enough *= 2
        numbers = range(enough // 2 + 1, enough + 1)
        return numbers[bisect_left(numbers, probability, key=reached)]

    n = fewest(asked)
    high = min(asked + PROBABILITY_ERROR, (1 + asked) / 2)
    interval = fewest(asked - PROBABILITY_ERROR), None if n is None else fewest(high)
    return Need(
        name, n, reached(MOST if n is None else n), interval, dict(sorted(probabilities.items()))
    )
