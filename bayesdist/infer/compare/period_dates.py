"""Periods (start and end dates), and sums over the matches of each period."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from astropy.time import Time

from bayesdist.data import Matches
from bayesdist.errors import InputError

__all__ = ["Periods", "check_periods", "mjd_periods", "sum_by_period"]

Periods = Mapping[str, tuple[float, float]]  # start and end in decimal years, by name

MOST_MJD = 2e6  # about five thousand years, close to the range of date libraries


def mjd_periods(centres: Sequence[float], days: float) -> dict[str, tuple[float, float]]:
    """Start and end dates (decimal years) of periods of `days` days, by name.

    Each period is centred on a Modified Julian Date, from `centres`, and named after it.

    Raises InputError if the length is not positive or a centre is not a valid date.
    """
    if not days > 0:
        raise InputError(
            f"the length of the periods is {days:g} days",
            where="periods",
            do="give a positive length",
        )
    beyond = [c for c in centres if not abs(c) < MOST_MJD]
    if beyond:
        raise InputError(
            f"a period is centred on {beyond[0]:g}, which is not a Modified Julian Date",
            where="periods",
            do="give days such as 55212.5",
        )
    # same time scale as for epochs that a file gives as Modified Julian Dates
    edges = np.asarray(centres, float)[:, None] + np.array([-days / 2, days / 2])
    years = np.asarray(Time(edges, format="mjd", scale="tt").decimalyear, float)
    return {
        f"{centre:.10g}": (float(start), float(stop))
        for centre, (start, stop) in zip(centres, years, strict=True)
    }


def check_periods(periods: Periods) -> None:
    """Raise InputError if there are fewer than two periods, or if they are reversed or overlap."""
    if len(periods) < 2:
        raise InputError(
            f"the number of periods is {len(periods)}",
            where="periods",
            do="give at least two periods to compare",
        )
    ordered = sorted(periods.items(), key=lambda one: one[1])
    for name, (start, stop) in ordered:
        if not start < stop:
            raise InputError(
                f"period {name} starts at {start:.8g} and ends at {stop:.8g}",
                where="periods",
                do="give the earlier date first",
            )
    for (first, before), (second, after) in pairwise(ordered):
        if after[0] < before[1]:
            raise InputError(
                f"periods {first} and {second} overlap",
                where="periods",
                do="start each period at or after the end of the previous one",
            )


def sum_by_period(matches: Matches, periods: Periods, task: Callable[[Matches], Any]) -> Any:
    """Sum the results of `task` over the matches of each period, in one pass over the data.

    `task` is called with the matches of a period in each chunk; its results must support addition.
    Matches outside all periods [start, end) are ignored.  Returns the sums by name of the period.
    Raises InputError if there are no epochs, periods overlap, or a period has no matches.
    """
    location = ", ".join(matches.sources)
    if not matches.has_epoch:
        raise InputError(
            "periods need an epoch for every pair", where=location, do="map column 'epoch'"
        )
    check_periods(periods)
    sums: dict[str, Any] = {}
    for table in matches.batches():
        epoch = table.column("epoch")
        for name, (start, stop) in periods.items():
            inside = (epoch >= start) & (epoch < stop)
            if inside.any():
                part = task(table.select(inside))
                sums[name] = sums[name] + part if name in sums else part
    for name, (start, stop) in periods.items():
        if name not in sums:
            raise InputError(
                f"period {name} ({start:.8g} to {stop:.8g}) has no pairs",
                where=location,
                do="correct the period or leave it out",
            )
    return {name: sums[name] for name in periods}
