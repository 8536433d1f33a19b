"""Kinds of truth whose exposures deviate in ways that hang together in time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from . import fields
from .exposure_kinds import (
    BREATHING,
    OF_TIME,
    Scatter,
    campaign,
    deviating,
    drifting,
    linear,
)
from .truth import Truth, kind, mapped

IN_TIME = (*OF_TIME, "autocorrelat", "correlated in time", "in time", "random walk", "ar(1)")
FIRST, LAST = 2002.0, 2012.0


def autoregressive(rng: np.random.Generator, n: int, rho: float, size: float) -> np.ndarray:
    """Scale and shears (n, 3) of exposures in the order of time, each remembering the last."""
    out = size * rng.standard_normal((n, 3))
    for k in range(1, n):
        out[k] = rho * out[k - 1] + np.sqrt(1 - rho**2) * out[k]
    return out


def walking(rng: np.random.Generator, n: int, size: float) -> np.ndarray:
    """Scale and shears (n, 3) that wander off by this much until the last exposure."""
    steps = size / np.sqrt(n) * rng.standard_normal((n, 3))
    return np.cumsum(steps, axis=0)


def stepping(rng: np.random.Generator, n: int, size: float) -> np.ndarray:
    """Scale and shears (n, 3) that change once, somewhere in the middle third."""
    after = np.arange(n) >= rng.integers(n // 3, 2 * n // 3)
    return after[:, None] * size * rng.choice([-1.0, 1.0], 3)


def in_time(
    rng: np.random.Generator,
    n: int,
    scatter: Scatter,
    *,
    exposures: int,
    beyond: float,
    single: bool,
) -> Truth:
    """Exposures of ten years with a drift, whose deviations are those of a chain.

    Parameters
    ----------
    rng : numpy.random.Generator
    n : int
        Stars of all exposures.
    scatter : callable
        Of scale and shears of the exposures, in their order, and of one more.
    exposures : int
    beyond : float
        Years after the last exposure at which positions are assessed.
    single : bool
        Whether positions are those of the exposure after the last one, and not those of the line.
    """
    rate = linear(*(0.004 * rng.standard_normal(3)))
    line = drifting(mapped(fields.distortion(rng)), rate)
    chain = scatter(rng, exposures + 1)
    truth = campaign(
        rng,
        n,
        line,
        exposures=exposures,
        dates=(FIRST, LAST),
        beyond=beyond,
        deviations=lambda rng, n: chain[:n],
    )
    if not single:
        return truth

    def true_map(x: np.ndarray, y: np.ndarray, epoch: Any = None) -> np.ndarray:
        return deviating(line(x, y, epoch), chain[-1:])

    config = truth.config | {"assess": {"exposure": "single"}}
    return replace(truth, true_map=true_map, config=config)


@kind("ar1_95", *IN_TIME, kindest=True, n=4000, exposures=30)
@kind("ar1_95_single", *IN_TIME, kindest=True, n=4000, exposures=30, single=True)
@kind("ar1_80_few", *IN_TIME, kindest=True, n=3000, exposures=12, rho=0.8)
def ar1(
    rng: np.random.Generator, n: int, exposures: int, rho: float = 0.95, single: bool = False
) -> Truth:
    """Scale and shears of exposures are an autoregressive chain, beside a drift; two years on."""
    return in_time(
        rng,
        n,
        lambda rng, n: autoregressive(rng, n, rho, 2 * BREATHING),
        exposures=exposures,
        beyond=2.0,
        single=single,
    )


@kind("random_walk_single", *IN_TIME, kindest=True, n=4000)
def random_walk(rng: np.random.Generator, n: int) -> Truth:
    """Scale and shears of 24 exposures wander off, beside a drift; some months on."""
    return in_time(
        rng,
        n,
        lambda rng, n: walking(rng, n, 3 * BREATHING),
        exposures=24,
        beyond=0.4,
        single=True,
    )


@kind("refocused", *IN_TIME, "break", "step", kindest=True, n=4000)
@kind("refocused_single", *IN_TIME, "break", "step", kindest=True, n=4000, single=True)
def refocused(rng: np.random.Generator, n: int, single: bool = False) -> Truth:
    """Scale and shears jump once, and the model has a line; true is how it is a year after."""
    truth = in_time(
        rng,
        n,
        lambda rng, n: stepping(rng, n, 2 * BREATHING),
        exposures=20,
        beyond=1.0,
        single=True,
    )
    return replace(
        truth, config=truth.config | {"assess": {"exposure": "single" if single else "mean"}}
    )
