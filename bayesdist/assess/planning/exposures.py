"""Number and dates of further exposures that would meet a requirement."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from bayesdist.utils.arrays import Float

MOST = 4096  # exposures beyond which more are no plan
# The range of the answer is that of the numbers whose probability differs by no more. Of exposures
# that were simulated as asked for fewer met their limits than was stated, by 0.27 +- 0.07
# (docs/validation.md).
PROBABILITY_ERROR = 0.25
SMALL = 0.05  # probability of meeting a limit, below which errors are said to be too large for it


@dataclass(frozen=True, eq=False)
class Schedule:
    """Dates at which exposures would be taken."""

    name: str
    # (d, d), of one exposure about polynomials and drift, on average over the dates of the schedule
    information: Float
    single_date: bool = False  # True if all further exposures have one date
    # possible information (d, d) of a number of exposures, where it is not their number times that
    # of one
    together: Sequence[Callable[[int], Float]] = ()

    def of(self, n: int) -> list[Float]:
        """Information (d, d) of n exposures: values that are equally probable."""
        return [one(n) for one in self.together] or [n * self.information]


@dataclass(frozen=True)
class Need:
    """Number of exposures that a schedule takes.

    Parameters
    ----------
    schedule : str
        Its name.
    exposures : int or None
        Fewest with which the requirement is met with the probability asked for; None where `MOST`
        are not enough.
    probability : float
        That the requirement is met with so many; with `MOST` where they are not enough.
    interval : tuple of (int or None)
        Fewest exposures for a probability lower and higher by `PROBABILITY_ERROR`; half way to 1
        where it would be nearer to it.  None where `MOST` are not enough.
    by_number : mapping of int to float
        Probability that the requirement is met, by the number of exposures, ascending.
    """

    schedule: str
    exposures: int | None
    probability: float
    interval: tuple[int | None, int | None] = (0, 0)
    by_number: Mapping[int, float] = field(default_factory=dict)

    @property
    def sentence(self) -> str:
        """The need in words."""
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
        """Probabilities of the numbers that were tried, in words; empty where it is met now."""
        return ", ".join(f"{n}: {p:.2f}" for n, p in self.by_number.items())


def exposures_needed(
    schedules: Sequence[Schedule],
    probability_of: Callable[[Schedule], Callable[[int], float]],
    asked: float,
    *,
    now: float,
) -> tuple[Need, ...]:
    """The fewest exposures of each schedule with which a requirement is met.

    Parameters
    ----------
    schedules : sequence of Schedule
    probability_of : callable
        From a schedule to the probability that the requirement is met with so many more exposures
        of it; with the same random numbers each time, so that it rises with their number.
    asked : float
        Probability to be reached.
    now : float
        Probability that the limit is met as it is.
    """
    if now >= asked:
        return tuple(Need(one.name, 0, now) for one in schedules)
    return tuple(_need(one.name, probability_of(one), asked) for one in schedules)


def _need(name: str, probability_met: Callable[[int], float], asked: float) -> Need:
    known = dict[int, float]()

    def reached(n: int) -> float:
        if n not in known:
            known[n] = probability_met(n)
        return known[n]

    def fewest(probability: float) -> int | None:
        enough = 1
        while reached(enough) < probability:  # doubling: most needs are small
            if enough == MOST:
                return None
            enough *= 2
        numbers = range(enough // 2 + 1, enough + 1)
        return numbers[bisect_left(numbers, probability, key=reached)]

    n = fewest(asked)
    high = min(asked + PROBABILITY_ERROR, (1 + asked) / 2)
    interval = fewest(asked - PROBABILITY_ERROR), None if n is None else fewest(high)
    return Need(name, n, reached(MOST if n is None else n), interval, dict(sorted(known.items())))
