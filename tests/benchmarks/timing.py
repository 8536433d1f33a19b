"""Clocks: repeats within a time limit, median or best."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable

__all__ = ["Deadline", "best", "median", "say"]


def say(text: str) -> None:
    """One line of progress on stderr."""
    print(text, file=sys.stderr, flush=True)


class Deadline:
    """A time limit that has to be asked."""

    def __init__(self, seconds: float) -> None:
        self.start, self.seconds = time.perf_counter(), seconds

    @property
    def elapsed(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self.start

    @property
    def over(self) -> bool:
        """Whether the time is up."""
        return self.elapsed > self.seconds


def _times(call: Callable[[], object], times: int, seconds: float) -> list[float]:
    limit, out = Deadline(seconds), []
    while len(out) < times and not (out and limit.over):
        start = time.perf_counter()
        call()
        out.append(time.perf_counter() - start)
    return out


def best(call: Callable[[], object], times: int = 3, seconds: float = 10.0) -> float:
    """Fewest seconds of some calls, for what other processes can only slow down.

    Parameters
    ----------
    call : callable
        Once before is up to the caller: compilation and first touches count otherwise.
    times : int
    seconds : float
        After which no further call begins.

    Returns
    -------
    float
    """
    return min(_times(call, times, seconds))


def median(call: Callable[[], object], times: int = 3, seconds: float = 60.0) -> float:
    """Median seconds of some calls; parameters as for `best`."""
    return statistics.median(_times(call, times, seconds))
