"""Periods: their begin and end, and sums over the matches of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from astropy.time import Time

from bayesdist.data import Matches
from bayesdist.errors import InputError

__all__ = ["Periods", "check_periods", "mjd_periods", "sum_by_period"]

Periods = Mapping[str, tuple[float, float]]  # begin and end by name, decimal years

MOST_MJD = 2e6  # some five thousand years: calendars end not far beyond


def mjd_periods(centres: Sequence[float], days: float) -> dict[str, tuple[float, float]]:
    """Periods of `days` about Modified Julian Dates, in decimal years, by name of the central date.

    InputError for a length that is not positive, and a centre that is no date.
    """
    if not days > 0:
        raise InputError(
            f"periods of {days:g} days are asked for", where="periods", do="give a positive length"
        )
    beyond = [c for c in centres if not abs(c) < MOST_MJD]
    if beyond:
        raise InputError(
            f"a period is centred on {beyond[0]:g}, which is no Modified Julian Date",
            where="periods",
            do="give days such as 55212.5",
        )
    # time scale of the epochs that a file gives as Modified Julian Dates
    edges = np.asarray(centres, float)[:, None] + np.array([-days / 2, days / 2])
    years = np.asarray(Time(edges, format="mjd", scale="tt").decimalyear, float)
    return {
        f"{centre:.10g}": (float(start), float(stop))
        for centre, (start, stop) in zip(centres, years, strict=True)
    }


def check_periods(periods: Periods) -> None:
    """Raise InputError for fewer than two periods, one that ends before it begins, or overlap."""
    if len(periods) < 2:
        raise InputError(
            f"{len(periods)} periods are given",
            where="periods",
            do="give two or more: a change needs a before",
        )
    ordered = sorted(periods.items(), key=lambda one: one[1])
    for name, (start, stop) in ordered:
        if not start < stop:
            raise InputError(
                f"period {name} goes from {start:.8g} to {stop:.8g}",
                where="periods",
                do="turn it round",
            )
    for (first, before), (second, after) in pairwise(ordered):
        if after[0] < before[1]:
            raise InputError(
                f"periods {first} and {second} overlap",
                where="periods",
                do="let each begin where the one before it is over, or later",
            )


def sum_by_period(matches: Matches, periods: Periods, task: Callable[[Matches], Any]) -> Any:
    """Sum of a task over the matches of each period, from one pass over the data in chunks.

    The matches need epochs; those outside all periods [first, end) are not used.  `task` gets the
    matches of a period in one chunk, and its results are added.  InputError without epochs, for
    periods that overlap, and for a period without matches.
    """
    where = ", ".join(matches.sources)
    if not matches.has_epoch:
        raise InputError(
            "periods need an epoch for every pair", where=where, do="map column 'epoch'"
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
                where=where,
                do="correct the period or leave it out",
            )
    return {name: sums[name] for name in periods}
