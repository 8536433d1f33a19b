"""The campaigns of the suite, one after the other or on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np

from .limits import limits_from, pilot, said_and_true
from .places import covered
from .ranks import ranks

CAMPAIGNS = {True: 24, False: 1}  # of each kind, in full and reduced
CALIBRATIONS, PILOTS = 200, 8  # in full alone
TRUTHS = {True: 200, False: 2}  # from the priors
EXPOSURES = 8  # of truths with several
JUDGED = ("drift", "pattern")


def over(function: Callable, arguments: Iterable[tuple], *, full: bool) -> list[Any]:
    """Results in order; a few are made here, as workers take seconds to begin."""
    if not full:
        return [function(*a) for a in arguments]
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        return list(pool.map(function, *zip(*arguments, strict=True), chunksize=4))


def coverage(kind: str, *, full: bool) -> list[dict]:
    return over(partial(covered, kind), [(k,) for k in range(CAMPAIGNS[full])], full=full)


def probabilities(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """What is said, and whether it is met, (n,) each."""
    pilots = over(partial(pilot, kind), [(k,) for k in range(PILOTS)], full=True)
    limits = limits_from(kind, pilots, CALIBRATIONS)
    seeds = range(10_000, 10_000 + CALIBRATIONS)  # not those of the coverage
    found = over(partial(said_and_true, kind), list(zip(limits, seeds, strict=True)), full=True)
    said, met = np.array(found, float).T
    return said, met


def all_ranks(*, full: bool, exposures: int = 1) -> dict[str, np.ndarray]:
    """Ranks of each quantity among the draws, one for each truth from the priors."""
    found = over(ranks, [(k, exposures) for k in range(TRUTHS[full])], full=full)
    return {name: np.array([one[name] for one in found]) for name in found[0]}
